"""`write_system`: a scanner into a new geometry workbook, or a copy of one in which nothing else changes."""

import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, several, warn
from ..files import AnyPath, replacing, write_bytes
from ..geometry.scanner import Scanner, first_true
from ..recording import recorded_warnings
from ..validation import instance
from .book import SAVING, Book, shortened
from .calculation import Recalculation
from .column_map import ColumnMap, column_map
from .edit import Edit
from .new_workbook import new_sheets, new_workbook
from .reader import read
from .workbook_xml import KINDS, Place, WorkbookXml

_NOT_IN_CELLS = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_LONGEST = 32_767
"""Characters of a text in Excel."""
_WITHIN = 2e-9
"""Largest relative error of a number that is written and read back."""


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
    system: Scanner,
    path: AnyPath,
    template: AnyPath | None = None,
    columns: ColumnMap | AnyPath | None = None,
) -> WrittenWorkbook:
    """Write a scanner's geometry workbook: pinholes, or a scanner of another kind.

    In a copy of `template`, only the cells that differ are written; modules are found by their numbers (or their order,
    without numbers), and cells as by `read_system`. A formula stays if it still gives the system's number (to 1e-9,
    relative). Each formula that depends on a changed cell stores its new value, or none if it cannot be calculated here,
    and the workbook is marked to be recalculated. All other parts of the file stay byte for byte. Removed modules leave
    empty rows, added ones come below the last, and modules in another order take the contents of their rows along. A column
    that modules may have (a tilt, the crystal's material) and that the copy lacks is added at the right of the modules'
    sheet, and the sheet of another kind of scanner as the last one.

    Parameters
    ----------
    path
        The file to write, .xlsx or .xlsm like the template; it may be the template, which is then replaced.
    template
        The workbook to copy. Default: a new one in the layout of the kind: for pinholes the users', with the sheets Main and
        Coordinates.
    columns
        The template's column map, or the path of one. Default: the one that the system was read by, if any.

    Raises
    ------
    InputError
        The template is refused by `read_system` or cannot hold the system, or the file cannot be written. The file
        at `path` is then as it was. An `InputWarning` is given of formulas that had to be replaced by numbers or store no
        value, and of ranges that leave added modules out.
    """
    instance(system, Scanner, "write_system")
    _refuse_texts(system)
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in KINDS:
        raise InputError(f"{target}: expected a name ending in {' or '.join(KINDS)}")
    if template is None:
        if suffix != ".xlsx":
            raise InputError(f"{target}: a workbook without a template has no macros, expected a name ending in .xlsx")
        content, values = new_workbook(system)
        write_bytes(target, content)
        return WrittenWorkbook(target.absolute(), (), values, ())
    read_by = None if system.source is None else system.source.columns
    if columns is not None:
        read_by = column_map(columns, template, type(system))
    with replacing(target) as temporary:
        book = Book(template)
        _refuse_other_suffix(book.workbook, target)
        if system.sheet and book.workbook.title(system.sheet) is None:
            written = _with_new_sheet(system, book.workbook, target, temporary)
        else:
            written = _edited(system, book, read_by, target, temporary)
    return written


def _refuse_texts(system: Scanner) -> None:
    """Refuse texts that no cell gives back: spreadsheets cut them off, and XML has no control characters."""
    for column in (column for column in system.columns.values() if column.is_text):
        for number, text in zip(system.numbers, column.values(system).tolist(), strict=True):
            if text != text.strip() or _NOT_IN_CELLS.search(text) or len(text) > _LONGEST:
                expected = f"at most {_LONGEST} characters without blanks at the ends and control characters"
                found = f"module {number}: {column.title} {shortened(repr(text))}"
                raise InputError(f"{found}: no cell can hold it, expected {expected}")


def _refuse_other_suffix(workbook: WorkbookXml, target: Path) -> None:
    if workbook.suffix is None:
        raise InputError(f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one")
    if workbook.suffix != target.suffix.lower():
        has = "has macros" if workbook.suffix == ".xlsm" else "is a workbook without macros"
        raise InputError(f"{target}: the template {workbook.name} {has}, expected a name ending in {workbook.suffix}")


def _with_new_sheet(system: Scanner, workbook: WorkbookXml, target: Path, temporary: Path) -> WrittenWorkbook:
    """Write the workbook with the sheet of a kind of scanner that it lacks."""
    sheets, stored = new_sheets(system, styled=False)
    ((title, rows),) = sheets.items()
    temporary.write_bytes(workbook.with_sheet(title, "".join(rows.values())))
    _refuse_other_system(temporary, workbook.name, None, system, numbered=True)
    filled = Book(temporary).sheet(title, "").cells.items()
    cells = tuple(workbook.text((title, *at)) for at, cell in sorted(filled) if not cell.blank)
    return WrittenWorkbook(target.absolute(), cells, stored, ())


def _edited(system: Scanner, book: Book, read_by: ColumnMap | None, target: Path, temporary: Path) -> WrittenWorkbook:
    """Write the workbook with its cells changed such that it holds a scanner."""
    workbook = book.workbook
    with recorded_warnings():  # they were given when the system was read
        reading = read(book, type(system), read_by)
    edit = Edit(system, reading, workbook)
    edited = workbook.changed
    recalculated = Recalculation(workbook, {*edited, *edit.unsettled}, edit.required, edit.expected)
    temporary.write_bytes(workbook.to_bytes())
    own = edit.column_map()
    _refuse_other_system(temporary, workbook.name, own, system, edit.numbered)
    _warn_of_formulas(workbook, recalculated)
    changed = tuple(workbook.text(place) for place in dict.fromkeys([*edited, *recalculated.replaced]))
    values = {workbook.text(place): value for place, value in sorted(recalculated.values.items())}
    cleared = tuple(workbook.text(place) for place in sorted(recalculated.cleared))
    return WrittenWorkbook(target.absolute(), changed, values, cleared, own)


def _refuse_other_system(path: Path, name: str, columns: ColumnMap | None, system: Scanner, numbered: bool) -> None:
    """Refuse a workbook that would be read as another scanner: a template may be laid out so that it cannot hold it."""
    cannot = f"{name} cannot hold this system"
    try:
        with recorded_warnings():
            back = read(Book(path), type(system), columns)
    except InputError as error:
        why = str(error).replace(str(path), name).replace(path.name, name)
        raise InputError(f"{cannot}, with it: {why}") from error
    if len(back.system) != len(system) or (numbered and not np.array_equal(back.system.numbers, system.numbers)):
        read_as = f"would be read as {several(back.system.numbers)}"
        raise InputError(f"{cannot}: its modules {several(system.numbers)} {read_as}")
    for declared in [system.columns[typed] for typed in system.columns.typed]:
        wanted, got = declared.values(system), declared.values(back.system)
        for i in first_true(~declared.agree(got, wanted, _WITHIN)):
            column = back.layout.columns.get(declared.name)
            why = f": {column.place(i)} is read for all modules" if column is not None and column.shared else ""
            number = f"{declared.name} = {declared.text_of(wanted[i], 9)} of module {system.numbers[i]}"
            raise InputError(f"{cannot}: {number} would be read as {declared.text_of(got[i], 9)}{why}")


def _warn_of_formulas(workbook: WorkbookXml, recalculated: Recalculation) -> None:
    replaced: dict[tuple[str, int], list[Place]] = defaultdict(list)
    for place in sorted(recalculated.replaced):
        replaced[place[0], place[2]].append(place)
    for places in replaced.values():
        cells, why = several(map(workbook.text, places), limit=1), recalculated.replaced[places[0]]
        warn(f"{workbook.name}: {cells}: the formula was replaced by the system's number ({why})")
    if recalculated.cleared:
        cleared, first = recalculated.cleared, next(iter(recalculated.cleared.values()))
        where = f"{workbook.name}: {several(map(workbook.text, cleared), limit=1)}"
        warn(f"{where}: the formula's new value could not be calculated ({first}); {SAVING} stores the value")
