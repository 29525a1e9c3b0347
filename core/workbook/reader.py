"""`read_system` and `read_scanner`: a geometry workbook as a scanner, and whether its numbers are possible and plausible."""

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
from .column_map import ColumnMap, column_map
from .headed_table import headed_tables
from .layout import ColumnCells, Layout, absent, mapped_layout
from .recognition import recognized_layout

_SHOWN = 5
"""Warnings of one column; the last one counts the rest."""


def read_system(path: AnyPath, columns: ColumnMap | AnyPath | None = None) -> PinholeSystem:
    """The pinhole scanner in a geometry workbook; `source` names the workbook and the cell of every number.

    Tables are found by their headings, listed in `core.geometry.pinhole_columns`, with their units. What could be mistaken
    is refused; `columns` then says what is meant. The pinhole centres, d, R, Ld and Td are needed, a number for each module
    or one for all. l comes from its column, and where that is blank from `collimator_length`. Modules without tilt aim at
    the isocentre. A stored value that is not what its formula gives is refused, unless all formulas store 0 or nothing.
    Numbers that follow from the others are only checked: one that differs by more than 1e-6 (relative, mm or radians) and
    by more than rounding in its last decimal is an `InputWarning`. So are columns that may be about the scanner and are not
    understood.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file, which is only read; it may be open in Excel.
    columns
        Which cells hold which column: a `ColumnMap`, or the path of one as TOML. Nothing else of the workbook is
        then read. Default: by the headings.

    Raises
    ------
    InputError
        Not a workbook, a heading, a note or a table that is not understood, or a cell that cannot be used: one
        line with sheet and cell, what is there and what was expected.
    """
    return _read(path, PinholeSystem, columns)


def read_scanner(path: AnyPath, kind: str, columns: ColumnMap | AnyPath | None = None) -> Scanner:
    """The scanner of a kind, such as "pinhole", in a geometry workbook that may hold others too; see `read_system`."""
    return _read(path, scanner_kind(kind), columns)


def kinds_in(path: AnyPath) -> tuple[str, ...]:
    """The kinds of scanners in a workbook: those whose own sheet it has, or whose headings are in its other sheets."""
    book = Book(path)
    own = {name: kind for name, kind in SCANNERS.items() if kind.sheet}
    found = [name for name, kind in own.items() if book.workbook.title(kind.sheet)]
    for name in SCANNERS.keys() - own.keys():
        tables = headed_tables(book, SCANNERS[name])[1]
        found += [name] if any(SCANNERS[name].columns.leading in table.columns for table in tables) else []
    return tuple(name for name in SCANNERS if name in found)


def _read(path: AnyPath, scanner: type[AnyScanner], columns: ColumnMap | AnyPath | None) -> AnyScanner:
    columns = column_map(columns, path, scanner)  # before the file, which may be large
    return read(Book(path), scanner, columns).system


@dataclass(frozen=True)
class Reading(Generic[AnyScanner]):
    """What is read from a workbook; `given` is what the cells hold, numbers in their units, NaN or "" for nothing."""

    layout: Layout
    given: dict[str, Array]
    system: AnyScanner


def read(book: Book, scanner: type[AnyScanner], columns: ColumnMap | None = None) -> Reading[AnyScanner]:
    """The scanner in `book` and where its numbers are; see `read_system`."""
    declared = scanner.columns
    layout = recognized_layout(book, scanner) if columns is None else mapped_layout(book, declared, columns)
    cells = layout.columns
    given = {name: cells[name].values() for name in declared.needed}
    values = {name: cells[name].in_code(given[name]) for name in declared.needed}
    for name in declared.dimensions:
        _refuse_not_positive(cells[name], values[name])
    numbers = layout.modules.module_numbers
    for name, i, why in scanner.faults(values, numbers, lambda name, i: cells[name].place(i)):
        raise InputError(f"{cells[name].where(i)} {why}")
    defaults = {name: declared[name].default(values) for name in declared.optional}
    values |= defaults
    for name in declared:  # causes before their effects
        if name in cells and name in declared.derived:
            given[name] = cells[name].values(True, declared[name].undefined(values))
        elif name in cells and name in declared.optional:
            given[name] = cells[name].values(columns is None or declared[name].is_text)
            in_sheet = cells[name].in_code(given[name])
            _refuse_not_positive(cells[name], in_sheet)
            values[name] = np.where(absent(given[name]), defaults[name], in_sheet)
    with naming(book.path.name):
        system = scanner.from_values(values, np.array(numbers), _source(book, layout, columns))
    for doubtful in _doubtful(book, cells, given, defaults, system):
        warn(doubtful, 4)
    return Reading(layout, given, system)


def _doubtful(
    book: Book, cells: dict[str, ColumnCells], given: Values, defaults: Values, system: Scanner
) -> Iterator[str]:
    """What is read but may be wrong, as texts of warnings; `defaults` are the values of blank cells, mm."""
    declared = system.columns
    for name in declared.optional:
        if name in given and declared[name].formula:
            yield from _differences(cells[name], given[name], defaults[name], "sheet")
    yield from _implausible(system, cells)
    for name in declared.derived:
        if name in given:
            rounded = declared[name].rounded_with
            slack = _rounding(cells[rounded], declared[rounded].values(system)) if rounded in cells else 0.0
            yield from _differences(cells[name], given[name], declared[name].values(system), "formula", slack)
    for place, why in list(book.unverified.items())[:1]:
        though = "the file asks to be calculated when it is opened and the formula cannot be computed here"
        yield f"{book.path.name}: {book.workbook.text(place)}: the stored value is used, though {though} ({why})"


def _rounding(column: ColumnCells, values: Floats) -> Floats:
    """By how much (M,) the numbers in a column's cells may be rounded, mm or rad."""
    return column.factor * np.array([tolerance(x, x, column.unit) for x in values / column.factor])


def _source(book: Book, layout: Layout, columns: ColumnMap | None) -> SystemSource:
    from openpyxl.utils import get_column_letter

    modules = layout.modules
    cells = [
        QuantityCells(name, column.table.sheet.name, get_column_letter(column.column), column.rows)
        for name, column in layout.columns.items()
    ]
    if modules.number_column is not None:
        letters = get_column_letter(modules.number_column)
        cells.insert(0, QuantityCells("number", modules.sheet.name, letters, modules.rows))
    dimension = (*modules.declared.dimensions, modules.declared.leading)[0]
    coordinates, dimensions = modules.sheet.name, layout.columns[dimension].table.sheet.name
    path, numbers = book.path.absolute(), modules.module_numbers
    return SystemSource(path, book.sha256, coordinates, dimensions, numbers, tuple(cells), columns)


def _refuse_not_positive(column: ColumnCells, values: Floats) -> None:
    """Raise `InputError` if a number (M,), mm or rad, is not positive but plausible ones are."""
    declared = column.declared
    for i in first_true(values <= 0) if declared.plausible[0] > 0 else ():
        raise InputError(f"{column.where(i)} has {declared.name} = {declared.text_of(values[i])}, expected more than 0")


def _implausible(system: Scanner, cells: dict[str, ColumnCells]) -> Iterator[str]:
    """For each column, the first module whose number is unlike that of any scanner."""
    for name, declared in system.columns.items():
        if declared.is_text:
            continue
        low, high = declared.plausible
        values = declared.values(system)
        column = cells[name if name in cells and not declared.derived else system.columns.leading]
        odd = np.flatnonzero((values < low) | (values > high))
        if len(odd):
            several = len(set(column.rows)) > 1 and len(odd) > 1
            more = f" (so it is for {len(odd) - 1} more modules)" if several else ""
            limits = f"{low / next(iter(declared.units.values())):g} to {declared.text_of(high)}"
            makes = f"makes {name} = {declared.text_of(values[odd[0]])}{more}"
            yield f"{column.where(int(odd[0]))} {makes}, which is unlikely, expected {limits}: are the units right?"


def _differences(
    column: ColumnCells, given: Floats, expected: Floats, used: str, slack: Floats | float = 0.0
) -> Iterator[str]:
    """The first modules whose number `given` (M,) in the sheet, in its unit, is not as `expected` (M,), mm or rad.

    The tolerance is larger by `slack`, mm, for rounding of the numbers behind `expected`. `used` says whose is taken.
    """
    name, unit = column.name, column.unit
    expected, slack = expected / column.factor, np.broadcast_to(slack, given.shape) / column.factor
    difference = np.abs(given - expected)
    if column.declared.kind == "angle":
        turn = 2 * math.pi / column.factor
        difference = np.abs((given - expected + turn / 2) % turn - turn / 2)
    filled = np.flatnonzero(np.isfinite(given)).tolist()
    differing = [i for i in filled if difference[i] > tolerance(given[i], expected[i], unit) + slack[i]]
    for n, i in enumerate(differing[:_SHOWN], start=1):
        more = f"; so do {len(differing) - _SHOWN} more cells of this column" if n == _SHOWN < len(differing) else ""
        both = f"has {name} = {given[i]:.9g} {unit}, the formula gives {expected[i]:.9g} {unit}"
        yield f"{column.where(i)} {both} (the {used}'s is used{more})"
