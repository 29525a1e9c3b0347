"""`write_system`: a `PinholeSystem` into a new geometry workbook, or a copy of one in which nothing else changes."""

import io
import os
import zipfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from ..errors import InputError, warn
from ..files import replacing, write_bytes
from ..geometry.system import PinholeSystem, same_place
from ..recording import recorded_warnings
from .book import Book
from .calculation import Recalculation
from .column_map import ColumnMap, column_map
from .edit import Edit, several
from .layout import MAX_MODULES
from .quantities import OPTIONAL, QUANTITIES, TYPED
from .reader import read
from .sheet_xml import CellError
from .workbook_xml import KINDS, Place, WorkbookXml

_PARTS = Path(__file__).with_name("new_workbook.txt")
"""The XML of a new workbook, its parts one after another, with their names above them."""
_NORMAL, _HEADING, _FOUR_DECIMALS = range(3)
"""Its styles of cells."""
_FIRST_ROW = 3
_LARGEST_NUMBER = 2**53 - 1
"""The first module's row, and the largest module's number that a cell holds exactly."""


@dataclass(frozen=True)
class WrittenWorkbook:
    """What `write_system` has written."""

    path: Path
    changed: tuple[str, ...]
    """The cells (``"Coordinates!B3"``) whose numbers or formulas are not the template's."""
    recalculated: dict[str, Any]
    """Cell -> the value that its formula stores now, of each that depends on these or stored no value before."""
    cleared: tuple[str, ...]
    """The cells whose formulas store no value now, because they cannot be calculated here."""
    columns: ColumnMap | None = None
    """The column map of the new file, with the modules' rows; None if its headings are understood without one."""


def write_system(
    system: PinholeSystem,
    path: str | os.PathLike[str],
    template: str | os.PathLike[str] | None = None,
    columns: ColumnMap | str | os.PathLike[str] | None = None,
) -> WrittenWorkbook:
    """Write a scanner's geometry workbook.

    In a copy of `template`, only the cells that differ are written; modules are found by their numbers (or their order,
    without numbers), and cells as by `read_system`. A formula stays if it still gives the system's number (to 1e-9,
    relative). Each formula that depends on a changed cell stores its new value, or none if it cannot be calculated here,
    and the workbook is marked to be recalculated. All other parts of the file stay byte for byte. Removed modules leave
    empty rows, added ones come below the last, and modules in another order take the contents of their rows along.

    Parameters
    ----------
    path
        The file to write, .xlsx or .xlsm like the template; it may be the template, which is then replaced.
    template
        The workbook to copy. Default: a new one in the users' layout, with the sheets Main and Coordinates.
    columns
        The template's column map, or the path of one. Default: the one that the system was read by, if any.

    Raises
    ------
    InputError
        The template is refused by `read_system` or cannot hold the system, or the file cannot be written. The file
        at `path` is then as it was. An `InputWarning` is given of formulas that had to be replaced by numbers or store no
        value, and of ranges that leave added modules out.
    """
    if not isinstance(system, PinholeSystem):
        raise InputError(f"write_system: expected a PinholeSystem, got {type(system).__name__}")
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in KINDS:
        raise InputError(f"{target}: expected a name ending in {' or '.join(KINDS)}")
    if template is None:
        if suffix != ".xlsx":
            raise InputError(f"{target}: a workbook without a template has no macros, expected a name ending in .xlsx")
        content, values = _new_workbook(system)
        write_bytes(target, content)
        return WrittenWorkbook(target.absolute(), (), values, ())
    read_by = None if system.source is None else system.source.columns
    if columns is not None:
        read_by = column_map(columns, template)
    with replacing(target) as temporary:
        book = Book(template)
        workbook = book.workbook
        if workbook.suffix is None:
            raise InputError(
                f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one"
            )
        if workbook.suffix != suffix:
            has = "has macros" if workbook.suffix == ".xlsm" else "is a workbook without macros"
            raise InputError(
                f"{target}: the template {workbook.name} {has}, expected a name ending in {workbook.suffix}"
            )
        with recorded_warnings():  # they were given when the system was read
            reading = read(book, read_by)
        edit = Edit(system, reading, workbook)
        edited = workbook.changed
        recalculated = Recalculation(workbook, {*edited, *edit.unsettled}, edit.required, edit.expected)
        temporary.write_bytes(workbook.to_bytes())
        own = edit.column_map()
        _refuse_other_system(temporary, workbook.name, own, system, edit.numbered)
    _warn_of_formulas(workbook, recalculated)
    return WrittenWorkbook(
        path=target.absolute(),
        changed=tuple(workbook.text(place) for place in dict.fromkeys([*edited, *recalculated.replaced])),
        recalculated={workbook.text(place): value for place, value in sorted(recalculated.values.items())},
        cleared=tuple(workbook.text(place) for place in sorted(recalculated.cleared)),
        columns=own,
    )


def _refuse_other_system(
    path: Path, name: str, columns: ColumnMap | None, system: PinholeSystem, numbered: bool
) -> None:
    """Refuse a workbook that would be read as another system: a template may be laid out so that it cannot hold it."""
    try:
        with recorded_warnings():
            back = read(Book(path), columns)
    except InputError as error:
        why = str(error).replace(str(path), name).replace(path.name, name)
        raise InputError(f"{name} cannot hold this system, with it: {why}") from error
    if len(back.system) != len(system) or (numbered and not np.array_equal(back.system.numbers, system.numbers)):
        raise InputError(
            f"{name} cannot hold this system: its modules {several(system.numbers)} would be read as "
            f"{several(back.system.numbers)}"
        )
    for quantity in [QUANTITIES[name] for name in TYPED]:
        if quantity.is_text:
            continue
        wanted, got = quantity.of(system), quantity.of(back.system)
        differing = np.flatnonzero(np.abs(got - wanted) > 2e-9 * np.abs(wanted))
        if len(differing):
            i = int(differing[0])
            column = back.layout.columns.get(quantity.name)
            why = f": {column.place(i)} is read for all modules" if column is not None and column.shared else ""
            raise InputError(
                f"{name} cannot hold this system: {quantity.name} = {quantity.text_of(wanted[i], 9)} of module "
                f"{system.numbers[i]} would be read as {quantity.text_of(got[i], 9)}{why}"
            )


def _warn_of_formulas(workbook: WorkbookXml, recalculated: Recalculation) -> None:
    replaced: dict[tuple[str, int], list[Place]] = defaultdict(list)
    for place in sorted(recalculated.replaced):
        replaced[place[0], place[2]].append(place)
    for places in replaced.values():
        warn(
            f"{workbook.name}: {several(map(workbook.text, places), shown=1)}: the formula was replaced by the system's "
            f"number ({recalculated.replaced[places[0]]})"
        )
    if recalculated.cleared:
        first = next(iter(recalculated.cleared.values()))
        warn(
            f"{workbook.name}: {several(map(workbook.text, recalculated.cleared), shown=1)}: the formula's new value could "
            f"not be calculated ({first}); opening the workbook in Excel or LibreOffice and saving it stores the value"
        )


def _new_workbook(system: PinholeSystem) -> tuple[bytes, dict[str, Any]]:
    """A workbook in the users' layout, and the value that each formula stores: the system's own.

    l is a number where it is not that of the formula.
    """
    _refuse_unreadable(system)
    x1, y1 = system.centers[:, :2].T
    with np.errstate(divide="ignore", over="ignore"):
        slope = system.pinhole_distance / x1
    divided_by_0 = {"slope": np.isinf(slope), "azimuth": np.hypot(x1, y1) == 0}
    typed = {name: ~QUANTITIES[name].is_default(system) for name in OPTIONAL}
    held = {name: q for name, q in QUANTITIES.items() if q.formula or name not in typed or typed[name].any()}
    columns = [
        *((name, q.place, q.titles or q.headings[:2], q.formula, q.of(system)) for name, q in held.items()),
        *(("number", f"{title}!A", ("", "Definitions"), "", system.numbers) for title in ("Main", "Coordinates")),
        ("slope", "Coordinates!F", ("S", "3D slope"), "={b}/{x1}", slope),
    ]
    cells: dict[str, dict[str, list[str]]] = {title: {} for title in ("Main", "Coordinates")}
    stored: dict[str, Any] = {}
    for name, place, titles, formula, values in columns:
        title, letters = place.split("!")
        style = _FOUR_DECIMALS if title == "Coordinates" and name != "number" else _NORMAL
        column = [_cell(f"{letters}{row}", text, _HEADING) for row, text in enumerate(titles, start=1)]
        places = {other: quantity.place.removeprefix(f"{title}!") for other, quantity in QUANTITIES.items()}
        for i, value in enumerate(values.tolist()):
            row, own = _FIRST_ROW + i, ""
            if formula and not (name in typed and typed[name][i]):
                own = formula.format_map({other: f"{its}{row}" for other, its in places.items()})
                value = CellError("#DIV/0!") if name in divided_by_0 and divided_by_0[name][i] else value
                stored[f"{place}{row}"] = value
            column.append(_cell(f"{letters}{row}", value, style, own))
        cells[title][letters] = column
    parts = dict(part.split("\n", 1) for part in _PARTS.read_text(encoding="ascii").split("--- ")[1:])
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for part, xml in parts.items():
            rows = _rows(cells.get(Path(part).stem, {}))
            # Dated 1980, so that a system always gives the same file.
            archive.writestr(zipfile.ZipInfo(part), xml.replace("<sheetData/>", rows), zipfile.ZIP_DEFLATED)
    return memory.getvalue(), stored


def _refuse_unreadable(system: PinholeSystem) -> None:
    """Refuse a system that `read_system` would refuse in any workbook, or read as another."""
    cannot, numbers = "the new workbook cannot hold this system", system.numbers
    if len(numbers) > MAX_MODULES:
        raise InputError(f"{cannot}: it has {len(numbers)} modules, expected at most {MAX_MODULES}")
    with np.errstate(over="ignore"):
        held = {"number": numbers.astype(np.float64), **{name: q.of(system) for name, q in QUANTITIES.items()}}
    for name, values in held.items():
        most = _LARGEST_NUMBER if name == "number" else np.finfo(np.float64).max
        if values.dtype.kind == "f" and np.any(bad := ~(np.abs(values) <= most)):
            i = int(np.argmax(bad))
            raise InputError(f"{cannot}: {name} of module {numbers[i]} is {values[i]:g}, expected at most {most:g}")
    if (same := same_place(system.centers)) is not None:
        first, second = (f"Coordinates!B{_FIRST_ROW + i}" for i in same)
        raise InputError(
            f"{cannot}, with it: the new workbook: {second} and y1, z1 put the pinhole of module {numbers[same[1]]} at "
            f"the place of module {numbers[same[0]]} ({first}), expected another place"
        )


def _cell(place: str, value: Any, style: int, formula: str = "") -> str:
    """A cell's XML; an empty text is no value."""
    kind = f' t="{"e" if isinstance(value, CellError) else "str"}"' if isinstance(value, str) else ""
    shown = escape(value) if isinstance(value, str) else repr(value).removesuffix(".0")
    content = (f"<f>{escape(formula[1:])}</f>" if formula else "") + (f"<v>{shown}</v>" if shown else "")
    return f'<c r="{place}" s="{style}"{kind}>{content}</c>'


def _rows(columns: dict[str, list[str]]) -> str:
    """The XML of a sheet's cells, given by the letters of their columns."""
    in_order = [columns[letters] for letters in sorted(columns, key=lambda letters: (len(letters), letters))]
    rows = (f'<row r="{row}">{"".join(cells)}</row>' for row, cells in enumerate(zip(*in_order, strict=True), start=1))
    return f"<sheetData>{''.join(rows)}</sheetData>"
