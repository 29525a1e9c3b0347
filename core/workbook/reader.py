"""Reader of geometry workbooks: `read_system` and `read_scanner`, with checks that numbers are possible and plausible."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError, naming, warn
from ..files import AnyPath
from ..geometry.columns import Values
from ..geometry.scanner import Scanner, first_true
from ..geometry.system import AnyScanner, PinholeSystem
from ..scanner_kinds import SCANNERS, scanner_kind
from ..system_source import QuantityCells, SystemSource
from .agreement import tolerance
from .book import Book
from .column_map import ColumnMap, load_column_map
from .headed_table import find_headed_tables
from .layout import ColumnCells, WorkbookLayout, is_absent, mapped_layout
from .recognition import headed_layout

_MAX_WARNINGS = 5
"""Largest number of warnings about one column; the last one gives the number of all others."""


def read_system(path: AnyPath, columns: ColumnMap | AnyPath | None = None) -> PinholeSystem:
    """Read the pinhole scanner in a geometry workbook; its `source` names the workbook and the cell of every number.

    Tables are found by their headings, listed in `core.geometry.pinhole_columns`, with their units. A workbook that could be
    misunderstood is refused; `columns` can then say what is meant. The pinhole centres, d, R, Ld and Td are needed, a number
    for each module or one for all. l comes from its column, and where that is blank from `collimator_length`. Modules
    without tilt aim at the isocentre. A stored value that differs from the value of its formula is refused, unless all
    formulas store 0 or nothing. Numbers that follow from other numbers are only checked: a number that differs by more than
    1e-6 (relative, mm or radians) and by more than rounding in its last decimal gives an `InputWarning`. So does a column
    that may be about the scanner and is not understood.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file, which is only read; it may be open in Excel.
    columns
        The cells of each column: a `ColumnMap`, or the path of one as TOML. Nothing else of the workbook is then read.
        Default: the cells under the headings.

    Raises
    ------
    InputError
        The file is not a workbook, a heading, a note or a table is not understood, or a cell cannot be used. The message is
        one line with sheet and cell, what is there and what was expected.
    """
    return _read(path, PinholeSystem, columns)


def read_scanner(path: AnyPath, kind: str, columns: ColumnMap | AnyPath | None = None) -> Scanner:
    """Read the scanner of a kind, such as "pinhole", in a geometry workbook that may hold others too; see `read_system`."""
    return _read(path, scanner_kind(kind), columns)


def kinds_in(path: AnyPath) -> tuple[str, ...]:
    """Return the kinds of the scanners in a workbook.

    A kind with a sheet of its own is there if the workbook has that sheet, any other kind if its headings are in a sheet.
    """
    book = Book(path)

    def is_in_book(kind: type[Scanner]) -> bool:
        """Return whether the workbook has the kind's sheet, or the heading of its leading column."""
        if kind.sheet:
            return book.workbook.find_title(kind.sheet) is not None
        return any(kind.columns.leading in table.columns for table in find_headed_tables(book, kind)[1])

    return tuple(name for name, kind in SCANNERS.items() if is_in_book(kind))


def _read(path: AnyPath, scanner: type[AnyScanner], columns: ColumnMap | AnyPath | None) -> AnyScanner:
    """Return the scanner of a class from the workbook file at `path`, by its headings or a column map."""
    columns = load_column_map(columns, path, scanner)  # before the workbook, which may be large
    return read_book(Book(path), scanner, columns).system


@dataclass(frozen=True)
class WorkbookReading(Generic[AnyScanner]):
    """Scanner that was read from a workbook, with the cells that hold it."""

    layout: WorkbookLayout
    cell_values: dict[str, Array]
    """Name of the scanner's column -> contents of its cells (M,), numbers in the cells' unit, NaN or "" for nothing."""
    system: AnyScanner


def read_book(book: Book, scanner: type[AnyScanner], columns: ColumnMap | None = None) -> WorkbookReading[AnyScanner]:
    """Read the scanner in an open `book`, by its headings or a column map, as `read_system` does."""
    definitions = scanner.columns
    layout = headed_layout(book, scanner) if columns is None else mapped_layout(book, definitions, columns)
    cells = layout.columns
    cell_values = {name: cells[name].read_values() for name in definitions.needed}
    values = {name: cells[name].to_scanner_units(cell_values[name]) for name in definitions.needed}
    for name in definitions.dimensions:
        _refuse_not_positive(cells[name], values[name])
    numbers = layout.modules.module_numbers
    for name, i, problem in scanner.faults(values, numbers, lambda name, i: cells[name].address(i)):
        raise InputError(f"{cells[name].location(i)} {problem}")
    defaults = {name: definitions[name].default(values) for name in definitions.optional}
    values |= defaults
    for name in definitions:  # causes before their effects
        if name in cells and name in definitions.derived:
            cell_values[name] = cells[name].read_values(True, definitions[name].undefined(values))
        elif name in cells and name in definitions.optional:
            cell_values[name] = cells[name].read_values(columns is None or definitions[name].is_text)
            in_sheet = cells[name].to_scanner_units(cell_values[name])
            _refuse_not_positive(cells[name], in_sheet)
            values[name] = np.where(is_absent(cell_values[name]), defaults[name], in_sheet)
    with naming(book.path.name):
        system = scanner.from_values(values, np.array(numbers), _system_source(book, layout, columns))
    for doubt in _find_doubtful_values(book, cells, cell_values, defaults, system):
        warn(doubt, 4)
    return WorkbookReading(layout, cell_values, system)


def _find_doubtful_values(
    book: Book, cells: dict[str, ColumnCells], cell_values: Values, defaults: Values, system: Scanner
) -> Iterator[str]:
    """Yield a warning for each value that was read and may be wrong.

    `cell_values` are the contents of the cells, numbers in their unit; `defaults` the values of blank cells, mm or rad.
    """
    definitions = system.columns
    for name in definitions.optional:
        if name in cell_values and definitions[name].formula:
            yield from _find_differences(cells[name], cell_values[name], defaults[name], "sheet")
    yield from _find_implausible_values(system, cells)
    for name in definitions.derived:
        if name in cell_values:
            rounded = definitions[name].rounded_with
            slack = _rounding_errors(cells[rounded], definitions[rounded].values(system)) if rounded in cells else 0.0
            expected = definitions[name].values(system)
            yield from _find_differences(cells[name], cell_values[name], expected, "formula", slack)
    for address, reason in list(book.unverified.items())[:1]:
        though = "the file asks to be calculated when it is opened and the formula cannot be computed here"
        cell = f"{book.path.name}: {book.workbook.address_text(address)}"
        yield f"{cell}: the stored value is used, though {though} ({reason})"


def _rounding_errors(column: ColumnCells, values: Floats) -> Floats:
    """Return the largest rounding error (M,) of the numbers `values` (M,) in a column's cells, all in mm or rad."""
    return column.factor * np.array([tolerance(x, x, column.unit) for x in values / column.factor])


def _system_source(book: Book, layout: WorkbookLayout, column_map: ColumnMap | None) -> SystemSource:
    """Return the record of the workbook and of the cells that a scanner is read from."""
    from openpyxl.utils import get_column_letter

    modules = layout.modules
    cells = [
        QuantityCells(name, column.table.sheet.name, get_column_letter(column.column), column.rows)
        for name, column in layout.columns.items()
    ]
    if modules.number_column is not None:
        letters = get_column_letter(modules.number_column)
        cells.insert(0, QuantityCells("number", modules.sheet.name, letters, modules.rows))
    dimension = (*modules.definitions.dimensions, modules.definitions.leading)[0]
    coordinates, dimensions = modules.sheet.name, layout.columns[dimension].table.sheet.name
    path, numbers = book.path.absolute(), modules.module_numbers
    return SystemSource(path, book.sha256, coordinates, dimensions, numbers, tuple(cells), column_map)


def _refuse_not_positive(column: ColumnCells, values: Floats) -> None:
    """Raise `InputError` if a number (M,), mm or rad, is not positive in a column whose plausible values all are."""
    for i in first_true(values <= 0) if column.definition.plausible[0] > 0 else ():
        has = f"has {column.name} = {column.definition.text_of(values[i])}"
        raise InputError(f"{column.location(i)} {has}, expected more than 0")


def _find_implausible_values(system: Scanner, cells: dict[str, ColumnCells]) -> Iterator[str]:
    """Yield for each column a warning about the first module whose number is outside the plausible limits."""
    for name, definition in system.columns.items():
        if definition.is_text:
            continue
        low, high = definition.plausible
        values = definition.values(system)
        column = cells[name if name in cells and not definition.derived else system.columns.leading]
        implausible = np.flatnonzero((values < low) | (values > high)).tolist()
        for i in implausible[:1]:
            are_several = len(set(column.rows)) > 1 and len(implausible) > 1
            repeated = f" (so it is for {len(implausible) - 1} more modules)" if are_several else ""
            limits = f"{low / next(iter(definition.units.values())):g} to {definition.text_of(high)}"
            makes = f"makes {name} = {definition.text_of(values[i])}{repeated}"
            yield f"{column.location(i)} {makes}, which is unlikely, expected {limits}: are the units right?"


def _find_differences(
    column: ColumnCells, cell_values: Floats, expected: Floats, used: str, slack: Floats | float = 0.0
) -> Iterator[str]:
    """Yield warnings about the first modules whose number in the sheet is not the expected one.

    `cell_values` (M,) are in the cells' unit, `expected` (M,) in mm or rad. The tolerance is larger by `slack`, mm or rad,
    for rounding of the numbers behind `expected`. `used` names the source of the number that is taken: sheet or formula.
    """
    name, unit = column.name, column.unit
    expected, slack = expected / column.factor, np.broadcast_to(slack, cell_values.shape) / column.factor
    difference = np.abs(cell_values - expected)
    if column.definition.kind == "angle":
        turn = 2 * math.pi / column.factor
        difference = np.abs((cell_values - expected + turn / 2) % turn - turn / 2)
    filled = np.flatnonzero(np.isfinite(cell_values)).tolist()
    differing = [i for i in filled if difference[i] > tolerance(cell_values[i], expected[i], unit) + slack[i]]
    for n, i in enumerate(differing[:_MAX_WARNINGS], start=1):
        is_cut = n == _MAX_WARNINGS < len(differing)
        rest = f"; so do {len(differing) - _MAX_WARNINGS} more cells of this column" if is_cut else ""
        both = f"has {name} = {cell_values[i]:.9g} {unit}, the formula gives {expected[i]:.9g} {unit}"
        yield f"{column.location(i)} {both} (the {used}'s is used{rest})"
