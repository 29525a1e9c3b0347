"""`write_system`: a `PinholeSystem` into a new geometry workbook, or a copy of one in which nothing else changes."""

import io
import os
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, first_line, warn
from ..files import replacing
from ..geometry.system import PinholeSystem
from ..recording import recorded_warnings
from ..validation import instance
from .book import Book
from .calculation import Recalculation
from .column_map import ColumnMap, column_map
from .edit import Edit, several
from .quantities import OPTIONAL, QUANTITIES, TYPED
from .reader import Reading, read
from .workbook_xml import KINDS, Place, WorkbookXml

_WIDTH = 13
_FIRST_ROW = 3
"""Column widths and the first module's row in a new workbook."""


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
    instance(system, PinholeSystem, "write_system")
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in KINDS:
        raise InputError(f"{target}: expected a name ending in {' or '.join(KINDS)}")
    if template is None and suffix != ".xlsx":
        raise InputError(f"{target}: a workbook without a template has no macros, expected a name ending in .xlsx")
    said = None if template is None or system.source is None else system.source.columns
    if template is not None and columns is not None:
        said = column_map(columns, template)
    with replacing(target) as temporary:
        if template is None:
            temporary.write_bytes(_new_workbook(system))
        book = Book(temporary if template is None else template)
        workbook = book.workbook
        if workbook.suffix is None:
            raise InputError(
                f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one"
            )
        if workbook.suffix != suffix:
            has = "has macros" if suffix == ".xlsx" else "is a workbook without macros"
            raise InputError(
                f"{target}: the template {workbook.name} {has}, expected a name ending in {workbook.suffix}"
            )
        name = "the new workbook" if template is None else workbook.name
        with recorded_warnings():  # they were given when the system was read
            reading = read(book, said) if template is not None else _read_written(temporary, name, None)
        edit = Edit(system, reading, workbook)
        edited = [] if template is None else workbook.changed
        to_recalculate = workbook.formulas if template is None else {*edited, *edit.unsettled}
        recalculated = Recalculation(workbook, to_recalculate, edit.required, edit.expected)
        temporary.write_bytes(workbook.to_bytes())
        own = edit.column_map()
        _refuse_other_system(_read_written(temporary, name, own), name, system, edit.numbered)
    _warn_of_formulas(workbook, recalculated)
    return WrittenWorkbook(
        path=target.absolute(),
        changed=tuple(workbook.text(place) for place in dict.fromkeys([*edited, *recalculated.replaced])),
        recalculated={workbook.text(place): value for place, value in sorted(recalculated.values.items())},
        cleared=tuple(workbook.text(place) for place in sorted(recalculated.cleared)),
        columns=own,
    )


def _read_written(path: Path, name: str, columns: ColumnMap | None) -> Reading:
    """A written workbook as it will be read; messages call it `name`."""
    try:
        with recorded_warnings():
            return read(Book(path), columns)
    except InputError as error:
        why = str(error).replace(str(path), name).replace(path.name, name)
        raise InputError(f"{name} cannot hold this system, with it: {why}") from error


def _refuse_other_system(back: Reading, name: str, system: PinholeSystem, numbered: bool) -> None:
    """Refuse a workbook that would be read as another system: a template may be laid out so that it cannot hold it."""
    if len(back.system) != len(system) or (numbered and not np.array_equal(back.system.numbers, system.numbers)):
        raise InputError(
            f"{name} cannot hold this system: its modules {several(system.numbers)} would be read as "
            f"{several(back.system.numbers)}"
        )
    for quantity in [QUANTITIES[name] for name in TYPED]:
        wanted, got = quantity.of(system), quantity.of(back.system)
        differing = np.flatnonzero(np.abs(got - wanted) > 2e-9 * np.abs(wanted))
        if len(differing):
            i = int(differing[0])
            column = back.layout.columns.get(quantity.name)
            why = f": {column.place(i)} is read for all modules" if column is not None and column.shared else ""
            raise InputError(
                f"{name} cannot hold this system: {quantity.name} = {quantity.said(wanted[i], 9)} of module "
                f"{system.numbers[i]} would be read as {quantity.said(got[i], 9)}{why}"
            )


def _warn_of_formulas(workbook: WorkbookXml, recalculated: Recalculation) -> None:
    by_column: dict[tuple[str, int], list[Place]] = defaultdict(list)
    for place in sorted(recalculated.replaced):
        by_column[place[0], place[2]].append(place)
    messages = [
        f"{several(map(workbook.text, places), shown=1)}: the formula was replaced by the system's number "
        f"({recalculated.replaced[places[0]]})"
        for places in by_column.values()
    ]
    if recalculated.cleared:
        places = list(recalculated.cleared)
        messages.append(
            f"{several(map(workbook.text, places), shown=1)}: the formula's new value could not be calculated "
            f"({recalculated.cleared[places[0]]}); opening the workbook in Excel or LibreOffice and saving it stores the "
            "value"
        )
    for message in messages:
        warn(f"{workbook.name}: {message}")


def _new_workbook(system: PinholeSystem) -> bytes:
    """A workbook in the users' layout, its formulas without values; l is a number where it is not that of the formula."""
    import openpyxl
    from openpyxl.styles import Alignment, Font

    book = openpyxl.Workbook()
    book.active.title = "Main"
    book.create_sheet("Coordinates")
    typed = {name: ~QUANTITIES[name].is_default(system) for name in OPTIONAL}
    columns = [
        *((name, q.place, q.titles or q.headings[:2], q.formula, q.of(system)) for name, q in QUANTITIES.items()),
        *(("number", f"{title}!A", ("", "Definitions"), "", system.numbers) for title in book.sheetnames),
        ("slope", "Coordinates!F", ("S", "3D slope"), "={b}/{x1}", system.numbers),
    ]
    for name, place, titles, formula, numbers in columns:
        title, letter = place.split("!")
        sheet = book[title]
        sheet.freeze_panes = "B3"
        sheet.column_dimensions[letter].width = _WIDTH
        for row, text in enumerate(titles, start=1):
            cell = sheet[f"{letter}{row}"]
            cell.value, cell.font = text or None, Font(bold=True)
            cell.alignment = Alignment(wrap_text=True, vertical="top", horizontal="center")
        places = {other: quantity.place.removeprefix(f"{title}!") for other, quantity in QUANTITIES.items()}
        for i, number in enumerate(numbers):
            row = _FIRST_ROW + i
            cell = sheet[f"{letter}{row}"]
            cell.value = number.item()
            if formula and not (name in typed and typed[name][i]):
                cell.value = formula.format_map({other: f"{column}{row}" for other, column in places.items()})
            if title == "Coordinates" and name != "number":
                cell.number_format = "0.0000"
    content = io.BytesIO()
    try:
        book.save(content)
    except Exception as error:  # lxml's, which has no name here: of the sheets' temporary files
        raise OSError(first_line(error)) from error
    return content.getvalue()
