"""Layout of a scanner in a workbook: the cell of each module in each column, whether from the headings or a column map."""

import itertools
import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Array, Bools
from ..errors import InputError, warn
from ..geometry.columns import ColumnTable
from .agreement import cell_text
from .book import HEADING_ROWS, Book, Sheet, parse_module_number
from .calculation import UncomputedValue
from .column_map import ColumnMap, MappedTable
from .headings import get_vocabulary, shows_as_stored

MAX_MODULES = 10_000

Label = int | str
"""Number or name that a row gives its module, such as 7 or "M01"."""


class ModuleTable:
    """Table in a sheet with a row for each module, or one row for all modules."""

    sheet: Sheet
    definitions: ColumnTable
    """Columns of the scanner's kind."""
    columns: dict[str, tuple[int, str]]
    """Name of the scanner's column -> column of the sheet, counted from 1, and unit of its numbers."""
    rows: tuple[int, ...]
    """Rows of the modules, counted from 1."""
    heading_rows: tuple[int, ...]
    """First and last row of the headings, one row if these are the same, none if a column map names no header row."""
    label_column: int | None
    """Column of the modules' numbers or names, None without one."""
    labels: tuple[Label, ...] | None = None
    """Number or name of the module of each row, once `read_labels` was called."""

    def read_labels(self) -> None:
        """Read the modules' numbers or names; raise `InputError` if one is missing or occurs twice."""
        if self.label_column is not None:
            self.labels = _read_labels(self.sheet, self.rows, self.label_column)

    @cached_property
    def numbers(self) -> tuple[int, ...] | None:
        """Numbers of the modules, row by row; None if the table has names or neither."""
        labels = self.labels
        return None if labels is None or any(isinstance(x, str) for x in labels) else tuple(map(int, labels))

    @property
    def number_column(self) -> int | None:
        """Column of the modules' numbers; None if the table has names or neither."""
        return None if self.numbers is None else self.label_column

    @cached_property
    def module_numbers(self) -> tuple[int, ...]:
        """Numbers of the modules, row by row; 1, 2, ... if the table has none."""
        return self.numbers or tuple(range(1, len(self.rows) + 1))


class ColumnCells:
    """Cells that hold the values of one column of the scanner.

    `modules` is the table with a row for each module, and `rows` has the row of each of its modules in `table`.
    """

    def __init__(self, table: ModuleTable, name: str, modules: ModuleTable, rows: tuple[int, ...]) -> None:
        self.table, self.name, self.modules, self.rows = table, name, modules, rows
        self.definition = table.definitions[name]
        """Definition of the scanner's column."""
        self.column, self.unit = table.columns[name]
        self.factor = self.definition.units[self.unit]
        """Value of the cells' unit in mm or rad."""
        self.shared = len(rows) > 1 and len(set(rows)) == 1
        """Whether one cell holds for all modules."""

    def location(self, i: int) -> str:
        """Return file, sheet and cell of the module with index `i`."""
        return self.table.sheet.location(self.rows[i], self.column)

    def address(self, i: int) -> str:
        """Return sheet and cell of the module with index `i`."""
        return self.table.sheet.address(self.rows[i], self.column)

    def read_values(self, optional: bool = False, ignored: Bools | None = None) -> Array:
        """Return the contents of the cells (M,), numbers in the cells' unit; raise `InputError` for any other content.

        NaN, or "" in a column of texts, stands for a module that is `ignored` (M,). With `optional`, it also stands for a
        blank cell, and for a formula that cannot be computed if the package can compute its value.
        """
        absent = "" if self.definition.is_text else math.nan
        values, sheet = [absent] * len(self.rows), self.table.sheet
        for i, row in enumerate(self.rows):
            if ignored is not None and ignored[i]:
                continue
            value = sheet.value(row, self.column)
            has_formula = bool(self.definition.derived or self.definition.formula)
            is_computable = isinstance(value, UncomputedValue) and has_formula
            if not (optional and (value is None or is_computable)):
                usable = None if value is None or sheet.is_date(row, self.column) else self._usable_value(value)
                if usable is None:
                    module = "" if self.shared else f" of module {self.modules.module_numbers[i]}"
                    expected = f"expected {self.name}{module}, {self.definition.expected}"
                    raise InputError(f"{self.location(i)} {sheet.describe_content(row, self.column)}, {expected}")
                values[i] = usable
        return np.array(values, np.str_ if self.definition.is_text else np.float64)

    def _usable_value(self, value: Any) -> float | str | None:
        """Return a cell's value as the number or text that the column takes, None if it cannot be one."""
        if self.definition.is_text:
            text = cell_text(value)
            return None if text is None or self.definition.parse(text) is None else text
        number = value if type(value) is float and math.isfinite(value) else None
        return None if number is None or (self.definition.kind == "whole" and number % 1) else number

    def to_scanner_units(self, values: Array) -> Array:
        """Return numbers in the cells' unit as mm or rad, and texts as the words of the scanner's column."""
        return np.array([*map(self.definition.parse, values)]) if self.definition.is_text else values * self.factor

    def to_cell_units(self, values: Array) -> Array:
        """Return numbers in mm or rad in the cells' unit; texts stay as they are."""
        return values if self.definition.is_text else values / self.factor


def is_absent(cell_values: Array) -> Bools:
    """Return for which modules (M,) a column's cells hold nothing: NaN, or "" in a column of texts."""
    return cell_values == "" if cell_values.dtype.kind == "U" else np.isnan(cell_values)


class WorkbookLayout:
    """Cells of all columns of a scanner in a workbook.

    `modules` is the table with a row for each module; of pinholes, it is the table of x1, y1 and z1.
    """

    def __init__(self, modules: ModuleTable) -> None:
        sheet, rows = modules.sheet, modules.rows
        leading = modules.definitions.position or (modules.definitions.leading,)
        where = f"{sheet.book.path.name}: sheet {sheet.name} has"
        if not rows:
            raise InputError(f"{where} no modules, expected rows with {', '.join(leading)}")
        if len(rows) > MAX_MODULES:
            raise InputError(f"{where} {len(rows)} modules, expected at most {MAX_MODULES}")
        self.modules = modules
        self.columns: dict[str, ColumnCells] = {}
        """Name of the scanner's column -> its cells."""
        self.rows_of: dict[ModuleTable, tuple[int, ...]] = {modules: rows}
        """Table with a row for each module -> the row of each module in it."""

    def add_column(self, table: ModuleTable, name: str, rows: tuple[int, ...]) -> None:
        """Enter the cells of the column `name` of the scanner: those of `table` in the modules' `rows`."""
        self.columns[name] = ColumnCells(table, name, self.modules, rows)


class _ColumnMapTable(ModuleTable):
    """Table in a sheet as a column map describes it."""

    def __init__(self, book: Book, definitions: ColumnTable, mapped: MappedTable) -> None:
        from openpyxl.utils import column_index_from_string as index

        self.sheet, self.definitions = book.sheet(mapped.sheet, ", which the column map names"), definitions
        self.columns = {c.quantity: (index(c.column), c.unit) for c in mapped.columns}
        self.rows = mapped.row_numbers()
        self.heading_rows = (mapped.header_row,) if mapped.header_row else ()
        self.label_column = None if mapped.number is None else index(mapped.number)
        self.read_labels()


def mapped_layout(book: Book, definitions: ColumnTable, column_map: ColumnMap) -> WorkbookLayout:
    """Return the layout that a complete column map describes."""
    tables: list[ModuleTable] = []
    for mapped in column_map.tables:
        tables.append(_ColumnMapTable(book, definitions, mapped))
        for contradiction in itertools.islice(_find_contradictions(tables[-1]), 1):
            warn(contradiction, 2)
    modules, layout = tables[0], WorkbookLayout(tables[0])
    for table, mapped in zip(tables, column_map.tables, strict=True):
        rows = modules.rows
        if mapped.rows == "one for all":
            rows = (table.rows[0],) * len(modules.rows)
        elif mapped.rows == "in order":
            rows = layout.rows_of[table] = match_rows_in_order(modules, table)
        elif mapped.rows == "by number":
            if modules.labels is None:
                matches = f"the column map matches the rows of sheet {mapped.sheet} by number"
                problem = "its first table has no number, expected the column of the modules' numbers there"
                raise InputError(f"{book.path.name}: {matches}, but {problem}")
            rows = layout.rows_of[table] = match_rows_by_label(modules, table)
        for name in table.columns:
            layout.add_column(table, name, rows)
    return layout


def _find_contradictions(table: ModuleTable) -> Iterator[str]:
    """Yield a message for each heading or number format that states another column or unit than the column map."""
    sheet, first_row, vocabulary = table.sheet, table.rows[0], get_vocabulary(table.definitions)
    for name, (column, unit) in table.columns.items():
        map_says = f"the column map says {name} in {unit}, which is used" if unit else f"the column map says {name}"
        for row in range(max(1, first_row - HEADING_ROWS), first_row):
            heading = vocabulary.parse_heading(sheet.texts.get((row, column), ""))
            if heading is not None and (heading.name != name or heading.unit not in (None, unit)):
                heading_says = heading.name + (f" in {heading.unit}" if heading.unit else "")
                yield f"{sheet.location(row, column)} says {heading_says}, {map_says}"
        number_format = sheet.number_format(first_row, column)
        if not table.definitions[name].is_text and not shows_as_stored(number_format, unit):
            yield f"{sheet.location(first_row, column)} is shown as {number_format!r}, {map_says}"


def match_rows_by_label(modules: ModuleTable, table: ModuleTable) -> tuple[int, ...]:
    """Return the row in `table` of each module of `modules`, found by the module's number or name.

    Modules that only `table` has are left out, with a warning.
    """
    assert modules.labels is not None and table.labels is not None, "both tables have labels that were read"
    row_of = dict(zip(table.labels, table.rows, strict=True))
    for label, row in zip(modules.labels, modules.rows, strict=True):
        if label not in row_of:
            location = modules.sheet.location(row, modules.label_column or 1)
            expected = f"a row for it in sheet {table.sheet.name} too, with its {', '.join(table.columns)}"
            raise InputError(f"{location} is module {label}, expected {expected}")
    if extra := [label for label in table.labels if label not in set(modules.labels)]:
        number = f" and {len(extra) - 1} more modules" if len(extra) > 1 else ""
        location = table.sheet.location(row_of[extra[0]], table.label_column or 1)
        problem = f"has module {extra[0]}{number} without coordinates in sheet {modules.sheet.name}"
        warn(f"{location} {problem}: left out", 2)
    return tuple(row_of[label] for label in modules.labels)


def match_rows_in_order(modules: ModuleTable, table: ModuleTable) -> tuple[int, ...]:
    """Return the row in `table` of each module of `modules`, matched in the order of the rows."""
    if len(table.rows) != len(modules.rows):
        name, (column, _) = next(iter(table.columns.items()))
        sheet, rows = table.sheet, table.rows
        problem = f"sheet {sheet.name} has {len(rows)} rows of {name}"
        cells = f"({sheet.address(rows[0], column)} to {sheet.address(rows[-1], column)})"
        expected = f"one or one for each of the {len(modules.rows)} modules of sheet {modules.sheet.name}"
        raise InputError(f"{sheet.book.path.name}: {problem} {cells}, expected {expected}")
    return table.rows


def _read_labels(sheet: Sheet, rows: tuple[int, ...], column: int) -> tuple[Label, ...]:
    """Return the numbers in a column, or its texts if all cells hold texts and not all of these are numbers.

    Raises `InputError` for a cell without a label and for a label that occurs twice.
    """
    values = [sheet.value(row, column) for row in rows]
    labels: list[Label | None] = [parse_module_number(value) for value in values]
    if all(type(value) is str for value in values) and None in labels:
        labels = [" ".join(str(value).split()) for value in values]
    row_of: dict[Label, int] = {}
    for row, label in zip(rows, labels, strict=True):
        location = sheet.location(row, column)
        if label is None:
            content = sheet.describe_content(row, column)
            raise InputError(f"{location} {content}, expected a module's number (or a name in every row)")
        if label in row_of:
            twin = sheet.address(row_of[label], column)
            raise InputError(f"{location} is module {label}, as is {twin}: expected another number")
        row_of[label] = row
    return tuple(row_of)
