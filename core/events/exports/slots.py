"""The users' own order of images: a ring in a row, and beside it mirrored images that fill the row up.

Their networks take 96 images of a scanner of 4 rings of 20 modules: slot = 24 row + column, where columns 20 to 23 hold
"the mirrored ones". The rings are open arcs, so that nothing was measured beyond a row's last module: what continues an
image without a step beyond its edge is its mirror image, as of a signal that is reflected at its end. So column 20 + j shows
the image of column 19 - j, flipped left to right. Whoever means other ones gives a table (`read_slots`).
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
"""Columns of mirrored images at the end of a row."""

_TRUE, _FALSE = ("1", "yes", "true"), ("0", "no", "false", "")
_ADVICE = "say which module each slot shows in a table of slots"


@dataclass(frozen=True, eq=False)
class Slots:
    """Which module each slot shows."""

    modules: Integers
    """Index (S,) of each slot's module among the scanner's."""
    mirrored: Bools
    """Whether each slot's image (S,) is flipped left to right."""
    columns: int
    """Slots in a row."""

    def __len__(self) -> int:
        return len(self.modules)

    def arranged(self, images: Floats32) -> Floats32:
        """The modules' images (M, n_v, n_u) as the slots' (S, n_v, n_u); "left to right" is along u."""
        taken = images[self.modules]
        taken[self.mirrored] = taken[self.mirrored][..., ::-1]
        return taken

    def table(self, system: Scanner) -> str:
        """What each slot shows as CSV: slot, row, column, the module's number and ring (from 1), mirrored (1 or 0)."""
        rings = system.rings() + 1
        lines = ["slot,row,column,module,ring,mirrored"]
        for slot, (m, mirrored) in enumerate(zip(self.modules.tolist(), self.mirrored.tolist(), strict=True)):
            row, column = divmod(slot, self.columns)
            lines.append(f"{slot},{row},{column},{system.numbers[m]},{rings[m]},{int(mirrored)}")
        return "\n".join(lines) + "\n"


def row_slots(system: Scanner) -> Slots:
    """A ring in a row, in the order of its modules, and after each row its last `MIRRORED` images mirrored.

    `InputError` where the rings are not of one size, or too small to mirror.
    """
    rings = system.rings()
    rows = [np.flatnonzero(rings == ring) for ring in dict.fromkeys(rings.tolist())]
    sizes = [len(row) for row in rows]
    if len(set(sizes)) > 1:
        rings_of = f"whose rings have {', '.join(map(str, sizes))} modules"
        raise InputError(f"the slots of a scanner {rings_of}: expected rings of one size; {_ADVICE}")
    if sizes[0] < MIRRORED:
        expected = f"{MIRRORED} or more, as many as are mirrored"
        raise InputError(f"the slots of a scanner with {sizes[0]} modules in a ring: expected {expected}; {_ADVICE}")
    modules = np.concatenate([np.concatenate([row, row[: -MIRRORED - 1 : -1]]) for row in rows])
    columns = sizes[0] + MIRRORED
    return Slots(modules, np.arange(len(modules)) % columns >= sizes[0], columns)


def read_slots(path: AnyPath, system: Scanner) -> Slots:
    """Slots from a table such as `Slots.table` writes: a CSV file with the columns slot, module and mirrored.

    Slots are counted from 0, modules are named by their numbers, and a column "column" says how many are in a row; others
    are not looked at. `InputError`, with the line, where something is missing or no module has the number.
    """
    lines = csv.DictReader(io.StringIO(read_text(path, "a table of slots")))
    for name in ("slot", "module", "mirrored"):
        if name not in (lines.fieldnames or ()):
            raise InputError(f"{path}: no column {name!r}; expected slot, module and mirrored")
    index = {int(number): m for m, number in enumerate(system.numbers)}
    modules, mirrored, columns = [], [], 1
    for slot, line in enumerate(lines):
        place = f"{path}, line {lines.line_num}"
        if (line["slot"] or "").strip() != str(slot):
            raise InputError(f"{place}: slot {line['slot']}: expected {slot}, slots are counted from 0 one by one")
        number = (line["module"] or "").strip()
        if not number.isdigit() or int(number) not in index:
            raise InputError(f"{place}: module {number!r}: expected the number of one of the set's modules")
        word = (line["mirrored"] or "").strip().lower()
        if word not in _TRUE + _FALSE:
            raise InputError(f"{place}: mirrored {word!r}: expected 1 or 0")
        modules.append(index[int(number)])
        mirrored.append(word in _TRUE)
        column = (line.get("column") or "").strip()
        columns = max(columns, int(column) + 1 if column.isdigit() else 1)
    if not modules:
        raise InputError(f"{path}: no slots; expected a line for each")
    return Slots(np.array(modules), np.array(mirrored), columns)
