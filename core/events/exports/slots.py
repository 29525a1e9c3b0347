"""Slots of images: the users' own order, a ring in a row, which mirrored images fill up.

The users' networks take 96 images of a scanner of 4 rings of 20 modules: slot = 24 row + column, where columns 20 to 23
hold mirrored images. The rings are open arcs, so that nothing was measured beyond a row's last module: as a signal is
reflected at its end, the mirror image continues an image beyond its edge without a step. So column 20 + j shows the image of
column 19 - j, flipped left to right. A table (`read_slots`) describes any other order.
"""

import csv
import io
from dataclasses import dataclass

import numpy as np

from ...arrays import Bools, Floats32, Integers
from ...errors import InputError
from ...files import AnyPath, read_text
from ...geometry.scanner import Scanner

MIRRORED = 4
"""Number of columns with mirrored images at the end of a row."""

_TRUE, _FALSE = ("1", "yes", "true"), ("0", "no", "false", "")
_ADVICE = "say which module each slot shows in a table of slots"


@dataclass(frozen=True, eq=False)
class Slots:
    """Order of images: the module that each of S slots shows, and whether mirrored."""

    modules: Integers
    """Index (S,) of each slot's module in the scanner."""
    mirrored: Bools
    """Whether each slot's image (S,) is flipped left to right."""
    columns: int
    """Number of slots in a row."""

    def __len__(self) -> int:
        return len(self.modules)

    def arrange(self, images: Floats32) -> Floats32:
        """Return the images of the slots (S, n_v, n_u), flipped along u where mirrored, from the modules' (M, n_v, n_u)."""
        arranged_images = images[self.modules]
        arranged_images[self.mirrored] = arranged_images[self.mirrored][..., ::-1]
        return arranged_images

    def table(self, system: Scanner) -> str:
        """Return a CSV table of the slots: slot, row, column, the module's number and ring (from 1), mirrored (1 or 0)."""
        rings = system.rings() + 1
        lines = ["slot,row,column,module,ring,mirrored"]
        for slot, (m, mirrored) in enumerate(zip(self.modules.tolist(), self.mirrored.tolist(), strict=True)):
            row, column = divmod(slot, self.columns)
            lines.append(f"{slot},{row},{column},{system.numbers[m]},{rings[m]},{int(mirrored)}")
        return "\n".join(lines) + "\n"


def row_slots(system: Scanner) -> Slots:
    """Return slots with a ring in a row, in the order of its modules, followed by its last `MIRRORED` images mirrored.

    `InputError` where the rings differ in size, or have fewer than `MIRRORED` modules.
    """
    rings = system.rings()
    rows = [np.flatnonzero(rings == ring) for ring in dict.fromkeys(rings.tolist())]
    sizes = [len(row) for row in rows]
    if len(set(sizes)) > 1:
        ring_sizes = f"whose rings have {', '.join(map(str, sizes))} modules"
        raise InputError(f"the slots of a scanner {ring_sizes}: expected rings of one size; {_ADVICE}")
    if sizes[0] < MIRRORED:
        expected = f"{MIRRORED} or more, as many as are mirrored"
        raise InputError(f"the slots of a scanner with {sizes[0]} modules in a ring: expected {expected}; {_ADVICE}")
    modules = np.concatenate([np.concatenate([row, row[: -MIRRORED - 1 : -1]]) for row in rows])
    columns = sizes[0] + MIRRORED
    return Slots(modules, np.arange(len(modules)) % columns >= sizes[0], columns)


def read_slots(path: AnyPath, system: Scanner) -> Slots:
    """Read slots from a table as `Slots.table` writes it: a CSV file with the columns slot, module and mirrored.

    Slots are counted from 0 and modules given by their numbers. The largest number in a column "column" gives the length of
    a row; other columns are ignored. `InputError` names the line where a value is missing or no module has the number.
    """
    table = csv.DictReader(io.StringIO(read_text(path, "a table of slots")))
    for name in ("slot", "module", "mirrored"):
        if name not in (table.fieldnames or ()):
            raise InputError(f"{path}: no column {name!r}; expected slot, module and mirrored")
    module_index = {int(number): m for m, number in enumerate(system.numbers)}
    modules, mirrored, columns = [], [], 1
    for slot, row in enumerate(table):
        location = f"{path}, line {table.line_num}"
        if (row["slot"] or "").strip() != str(slot):
            raise InputError(f"{location}: slot {row['slot']}: expected {slot}, slots are counted from 0 one by one")
        number = (row["module"] or "").strip()
        if not number.isdigit() or int(number) not in module_index:
            raise InputError(f"{location}: module {number!r}: expected the number of one of the set's modules")
        mirrored_word = (row["mirrored"] or "").strip().lower()
        if mirrored_word not in _TRUE + _FALSE:
            raise InputError(f"{location}: mirrored {mirrored_word!r}: expected 1 or 0")
        modules.append(module_index[int(number)])
        mirrored.append(mirrored_word in _TRUE)
        column = (row.get("column") or "").strip()
        columns = max(columns, int(column) + 1 if column.isdigit() else 1)
    if not modules:
        raise InputError(f"{path}: no slots; expected a line for each")
    return Slots(np.array(modules), np.array(mirrored), columns)
