"""Writer of a scanner into a new geometry workbook, or into a copy of a workbook in which nothing else changes."""

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
from .book import SAVING, Book, shorten
from .calculation import Recalculation
from .column_map import ColumnMap, load_column_map
from .edit import WorkbookEdit
from .new_workbook import new_sheets, new_workbook
from .reader import read_book
from .workbook_xml import CONTENT_TYPE_OF_SUFFIX, Address, WorkbookXml

_NOT_IN_CELLS = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_MAX_TEXT_LENGTH = 32_767
"""Largest number of characters of a text in Excel."""
_WRITING_ERROR = 2e-9
"""Largest relative error of a number that is written and read back."""


@dataclass(frozen=True)
class WrittenWorkbook:
    """Workbook that `write_system` has written, with its differences from the template."""

    path: Path
    changed: tuple[str, ...]
    """The cells (``"Coordinates!B3"``) whose numbers or formulas are not the template's."""
    recalculated: dict[str, Any]
    """Cell -> new stored value of its formula, of each formula that depends on a changed cell or stored no value before."""
    cleared: tuple[str, ...]
    """The cells whose formulas store no value now, because they cannot be calculated here."""
    columns: ColumnMap | None = None
    """The column map of the new file, with the modules' rows; None if its headings are understood without one."""


def write_system(
    system: Scanner, path: AnyPath, template: AnyPath | None = None, columns: ColumnMap | AnyPath | None = None
) -> WrittenWorkbook:
    """Write a scanner's geometry workbook: pinholes, or a scanner of another kind.

    In a copy of `template`, only the cells that differ are written. Modules are found by their numbers, or by their order in
    a workbook without numbers; cells are found as by `read_system`. A formula stays if it still gives the system's number
    (to 1e-9, relative). Each formula that depends on a changed cell stores its new value, or none if it cannot be calculated
    here, and the workbook is marked to be recalculated. All other parts of the file stay byte for byte. Removed modules
    leave empty rows, added ones come below the last, and modules in another order take the contents of their rows along. A
    column that modules may have (a tilt, the crystal's material) and that the copy lacks is added at the right of the
    modules' sheet, and the sheet of another kind of scanner as the last one.

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
    _refuse_unstorable_texts(system)
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in CONTENT_TYPE_OF_SUFFIX:
        raise InputError(f"{target}: expected a name ending in {' or '.join(CONTENT_TYPE_OF_SUFFIX)}")
    if template is None:
        if suffix != ".xlsx":
            raise InputError(f"{target}: a workbook without a template has no macros, expected a name ending in .xlsx")
        content, values = new_workbook(system)
        write_bytes(target, content)
        return WrittenWorkbook(target.absolute(), (), values, ())
    column_map = None if system.source is None else system.source.columns
    if columns is not None:
        column_map = load_column_map(columns, template, type(system))
    with replacing(target) as temporary:
        book = Book(template)
        _refuse_other_suffix(book.workbook, target)
        if system.sheet and book.workbook.find_title(system.sheet) is None:
            return _write_with_new_sheet(system, book.workbook, target, temporary)
        return _write_edited(system, book, column_map, target, temporary)


def _refuse_unstorable_texts(system: Scanner) -> None:
    """Raise `InputError` for texts that no cell gives back: spreadsheets cut them off, XML has no control characters."""
    for column in (column for column in system.columns.values() if column.is_text):
        for number, text in zip(system.numbers, column.values(system).tolist(), strict=True):
            if text != text.strip() or _NOT_IN_CELLS.search(text) or len(text) > _MAX_TEXT_LENGTH:
                expected = f"at most {_MAX_TEXT_LENGTH} characters without blanks at the ends and control characters"
                value = f"module {number}: {column.title} {shorten(repr(text))}"
                raise InputError(f"{value}: no cell can hold it, expected {expected}")


def _refuse_other_suffix(workbook: WorkbookXml, target: Path) -> None:
    """Raise `InputError` if the content of the template does not fit the ending of the file to write."""
    if workbook.suffix is None:
        raise InputError(f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one")
    if workbook.suffix != target.suffix.lower():
        has = "has macros" if workbook.suffix == ".xlsm" else "is a workbook without macros"
        raise InputError(f"{target}: the template {workbook.name} {has}, expected a name ending in {workbook.suffix}")


def _write_with_new_sheet(system: Scanner, workbook: WorkbookXml, target: Path, temporary: Path) -> WrittenWorkbook:
    """Write the workbook into the file `temporary`, with a new sheet for a kind of scanner that it lacks."""
    sheets, stored = new_sheets(system, styled=False)
    ((title, rows),) = sheets.items()
    temporary.write_bytes(workbook.to_bytes_with_sheet(title, "".join(rows.values())))
    _refuse_other_reading(temporary, workbook.name, None, system, numbered=True)
    filled = Book(temporary).sheet(title, "").cells.items()
    cells = tuple(workbook.address_text((title, *position)) for position, cell in sorted(filled) if not cell.blank)
    return WrittenWorkbook(target.absolute(), cells, stored, ())


def _write_edited(
    system: Scanner, book: Book, columns: ColumnMap | None, target: Path, temporary: Path
) -> WrittenWorkbook:
    """Write the workbook into the file `temporary`, with its cells changed such that they hold a scanner."""
    workbook = book.workbook
    with recorded_warnings():  # they were given when the system was read
        reading = read_book(book, type(system), columns)
    edit = WorkbookEdit(system, reading, workbook)
    edited = workbook.changed_addresses
    recalculated = Recalculation(workbook, {*edited, *edit.unsettled}, edit.required, edit.expected)
    temporary.write_bytes(workbook.to_bytes())
    new_map = edit.column_map()
    _refuse_other_reading(temporary, workbook.name, new_map, system, edit.numbered)
    _warn_of_formulas(workbook, recalculated)
    changed = dict.fromkeys([*edited, *recalculated.replaced])
    values = {workbook.address_text(address): value for address, value in sorted(recalculated.values.items())}
    cleared = tuple(workbook.address_text(address) for address in sorted(recalculated.cleared))
    return WrittenWorkbook(target.absolute(), tuple(map(workbook.address_text, changed)), values, cleared, new_map)


def _refuse_other_reading(path: Path, name: str, columns: ColumnMap | None, system: Scanner, numbered: bool) -> None:
    """Raise `InputError` if the workbook at `path` is not read as the scanner `system`.

    A template can be laid out so that it cannot hold the scanner. `name` is the template's name for messages; the modules'
    numbers are compared if it is `numbered`.
    """
    cannot = f"{name} cannot hold this system"
    try:
        with recorded_warnings():
            reading = read_book(Book(path), type(system), columns)
    except InputError as error:
        reason = str(error).replace(str(path), name).replace(path.name, name)
        raise InputError(f"{cannot}, with it: {reason}") from error
    read_back = reading.system
    if len(read_back) != len(system) or (numbered and not np.array_equal(read_back.numbers, system.numbers)):
        read_as = f"would be read as {several(read_back.numbers)}"
        raise InputError(f"{cannot}: its modules {several(system.numbers)} {read_as}")
    for definition in [system.columns[name] for name in system.columns.typed]:
        expected, values = definition.values(system), definition.values(read_back)
        for i in first_true(~definition.agree(values, expected, _WRITING_ERROR)):
            column = reading.layout.columns.get(definition.name)
            reason = f": {column.address(i)} is read for all modules" if column is not None and column.shared else ""
            number = f"{definition.name} = {definition.text_of(expected[i], 9)} of module {system.numbers[i]}"
            raise InputError(f"{cannot}: {number} would be read as {definition.text_of(values[i], 9)}{reason}")


def _warn_of_formulas(workbook: WorkbookXml, recalculated: Recalculation) -> None:
    """Warn of formulas that were replaced by numbers, once per column, and of formulas that store no value."""
    replaced: dict[tuple[str, int], list[Address]] = defaultdict(list)
    for address in sorted(recalculated.replaced):
        replaced[address[0], address[2]].append(address)
    for addresses in replaced.values():
        cells, reason = several(map(workbook.address_text, addresses), limit=1), recalculated.replaced[addresses[0]]
        warn(f"{workbook.name}: {cells}: the formula was replaced by the system's number ({reason})")
    if recalculated.cleared:
        cleared, reason = recalculated.cleared, next(iter(recalculated.cleared.values()))
        cells = f"{workbook.name}: {several(map(workbook.address_text, cleared), limit=1)}"
        warn(f"{cells}: the formula's new value could not be calculated ({reason}); {SAVING} stores the value")
