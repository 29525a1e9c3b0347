"""Which cells hold which column of which module, whether the headings say so or a column map."""

import itertools
import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Array, Bools
from ..errors import InputError, warn
from ..geometry.columns import ColumnTable
from .agreement import text_of
from .book import HEADING_ROWS, Book, Sheet, module_number
from .calculation import Uncomputed
from .column_map import ColumnMap
from .headings import shows_as_stored, vocabulary

MAX_MODULES = 10_000

Label = int | str
"""What a row calls its module: a number, or a name such as "M01"."""


class Table:
    """Rows of a sheet that hold modules; `columns` is name -> column of the sheet and unit, of those that are `declared`.

    `heading_rows` are the first and the last row of its headings, `label_column` that of the modules' numbers or names.
    """

    sheet: Sheet
    declared: ColumnTable
    columns: dict[str, tuple[int, str]]
    rows: tuple[int, ...]
    heading_rows: tuple[int, ...]
    label_column: int | None
    labels: tuple[Label, ...] | None = None
    """What the rows call their modules, once it is read."""

    def read_labels(self) -> None:
        """Read what the rows call their modules; `InputError` if that does not tell them apart."""
        if self.label_column is not None:
            self.labels = _labels(self.sheet, self.rows, self.label_column)

    @cached_property
    def numbers(self) -> tuple[int, ...] | None:
        """The modules' numbers, if the table has numbers."""
        labels = self.labels
        return None if labels is None or any(isinstance(x, str) for x in labels) else tuple(map(int, labels))

    @property
    def number_column(self) -> int | None:
        """The column of the modules' numbers, if the table has numbers."""
        return None if self.numbers is None else self.label_column

    @cached_property
    def module_numbers(self) -> tuple[int, ...]:
        """The table's numbers, else 1, 2, ..."""
        return self.numbers or tuple(range(1, len(self.rows) + 1))


class ColumnCells:
    """The cells of one column of the scanner; `factor` is their unit in mm or rad.

    `rows` has the row of each module of the table of `modules`, all the same if one cell holds for all (`shared`).
    """

    def __init__(self, table: Table, name: str, modules: Table, rows: tuple[int, ...]) -> None:
        self.table, self.name, self.modules, self.rows = table, name, modules, rows
        self.declared = table.declared[name]
        self.column, self.unit = table.columns[name]
        self.factor = self.declared.units[self.unit]
        self.shared = len(rows) > 1 and len(set(rows)) == 1

    def where(self, i: int) -> str:
        """File, sheet and cell of module index `i`."""
        return self.table.sheet.where(self.rows[i], self.column)

    def place(self, i: int) -> str:
        """Sheet and cell of module index `i`."""
        return self.table.sheet.place(self.rows[i], self.column)

    def values(self, optional: bool = False, ignored: Bools | None = None) -> Array:
        """What the cells hold (M,), numbers in their unit; `InputError` if one holds something else.

        NaN, or "" for a text, where they are `ignored`, or where a cell is blank, or its formula cannot be computed here but
        by the package, if they are `optional`.
        """
        absent = "" if self.declared.is_text else math.nan
        found, sheet = [absent] * len(self.rows), self.table.sheet
        for i, row in enumerate(self.rows):
            if ignored is not None and ignored[i]:
                continue
            value = sheet.value(row, self.column)
            known = isinstance(value, Uncomputed) and bool(self.declared.derived or self.declared.formula)
            if not (optional and (value is None or known)):
                held = None if value is None or sheet.is_date(row, self.column) else self._held(value)
                if held is None:
                    of = "" if self.shared else f" of module {self.modules.module_numbers[i]}"
                    seen = sheet.found(row, self.column)
                    raise InputError(f"{self.where(i)} {seen}, expected {self.name}{of}, {self.declared.expected}")
                found[i] = held
        return np.array(found, np.str_ if self.declared.is_text else np.float64)

    def _held(self, value: Any) -> float | str | None:
        """What a cell with this value holds, None if it is nothing for this column."""
        if self.declared.is_text:
            text = text_of(value)
            return None if text is None or self.declared.parse(text) is None else text
        number = value if type(value) is float and math.isfinite(value) else None
        return None if number is None or (self.declared.kind == "whole" and number % 1) else number

    def in_code(self, given: Array) -> Array:
        """Numbers in the cells' unit as mm or rad, texts as the scanner has them."""
        return np.array([self.declared.parse(text) for text in given]) if self.declared.is_text else given * self.factor

    def in_cells(self, values: Array) -> Array:
        """Numbers in mm or rad in the cells' unit; texts as they are."""
        return values if self.declared.is_text else values / self.factor


def absent(given: Array) -> Bools:
    """Where (M,) a column's cells hold nothing."""
    return given == "" if given.dtype.kind == "U" else np.isnan(given)


class Layout:
    """Where a workbook's numbers are.

    `modules` is the table of x1, y1, z1; `rows_of` has the row of each module in every table with a row for each.
    """

    def __init__(self, modules: Table) -> None:
        sheet, rows, leading = modules.sheet, modules.rows, modules.declared.position or (modules.declared.leading,)
        where = f"{sheet.book.path.name}: sheet {sheet.name} has"
        if not rows:
            raise InputError(f"{where} no modules, expected rows with {', '.join(leading)}")
        if len(rows) > MAX_MODULES:
            raise InputError(f"{where} {len(rows)} modules, expected at most {MAX_MODULES}")
        self.modules = modules
        self.columns: dict[str, ColumnCells] = {}
        self.rows_of: dict[Table, tuple[int, ...]] = {modules: rows}

    def add(self, table: Table, name: str, rows: tuple[int, ...]) -> None:
        """Take a column's cells from these rows of a table."""
        self.columns[name] = ColumnCells(table, name, self.modules, rows)


class _MappedTable(Table):
    """A table as a column map describes it."""

    def __init__(self, book: Book, declared: ColumnTable, mapped: Any) -> None:
        from openpyxl.utils import column_index_from_string as index

        self.sheet, self.declared = book.sheet(mapped.sheet, ", which the column map names"), declared
        self.columns = {c.quantity: (index(c.column), c.unit) for c in mapped.columns}
        self.rows = mapped.row_numbers()
        self.heading_rows = (mapped.header_row,) if mapped.header_row else ()
        self.label_column = None if mapped.number is None else index(mapped.number)
        self.read_labels()


def mapped_layout(book: Book, declared: ColumnTable, columns: ColumnMap) -> Layout:
    """The layout that a complete column map describes."""
    tables: list[Table] = []
    for mapped in columns.tables:
        tables.append(_MappedTable(book, declared, mapped))
        for contradiction in itertools.islice(_contradictions(tables[-1]), 1):
            warn(contradiction, 2)
    modules, layout = tables[0], Layout(tables[0])
    for table, mapped in zip(tables, columns.tables, strict=True):
        rows = modules.rows
        if mapped.rows == "one for all":
            rows = (table.rows[0],) * len(modules.rows)
        elif mapped.rows == "in order":
            rows = layout.rows_of[table] = in_order(modules, table)
        elif mapped.rows == "by number":
            if modules.labels is None:
                matches = f"the column map matches the rows of sheet {mapped.sheet} by number"
                found = "its first table has no number, expected the column of the modules' numbers there"
                raise InputError(f"{book.path.name}: {matches}, but {found}")
            rows = layout.rows_of[table] = by_label(modules, table)
        for name in table.columns:
            layout.add(table, name, rows)
    return layout


def _contradictions(table: Table) -> Iterator[str]:
    """The headings and number formats of mapped columns that say another unit or column than the map."""
    sheet, first, heading_of = table.sheet, table.rows[0], vocabulary(table.declared).heading_of
    for name, (column, unit) in table.columns.items():
        used = f"the column map says {name} in {unit}, which is used" if unit else f"the column map says {name}"
        for row in range(max(1, first - HEADING_ROWS), first):
            heading = heading_of(sheet.texts.get((row, column), ""))
            if heading is not None and (heading.name != name or heading.unit not in (None, unit)):
                says = heading.name + (f" in {heading.unit}" if heading.unit else "")
                yield f"{sheet.where(row, column)} says {says}, {used}"
        shown = sheet.number_format(first, column)
        if not table.declared[name].is_text and not shows_as_stored(shown, unit):
            yield f"{sheet.where(first, column)} is shown as {shown!r}, {used}"


def by_label(modules: Table, table: Table) -> tuple[int, ...]:
    """The row of each module in `table`, by what both call it; a warning is given of modules only `table` has."""
    assert modules.labels is not None and table.labels is not None, "asked only of tables with labels"
    row_of = dict(zip(table.labels, table.rows, strict=True))
    for label, row in zip(modules.labels, modules.rows, strict=True):
        if label not in row_of:
            where = modules.sheet.where(row, modules.label_column or 1)
            expected = f"a row for it in sheet {table.sheet.name} too, with its {', '.join(table.columns)}"
            raise InputError(f"{where} is module {label}, expected {expected}")
    extra = [label for label in table.labels if label not in set(modules.labels)]
    if extra:
        more = f" and {len(extra) - 1} more modules" if len(extra) > 1 else ""
        where = table.sheet.where(row_of[extra[0]], table.label_column or 1)
        left = f"has module {extra[0]}{more} without coordinates in sheet {modules.sheet.name}"
        warn(f"{where} {left}: left out", 2)
    return tuple(row_of[label] for label in modules.labels)


def in_order(modules: Table, table: Table) -> tuple[int, ...]:
    """The row of each module in `table`, row by row."""
    if len(table.rows) != len(modules.rows):
        name, (column, _) = next(iter(table.columns.items()))
        sheet, rows = table.sheet, table.rows
        has = f"sheet {sheet.name} has {len(rows)} rows of {name}"
        places = f"({sheet.place(rows[0], column)} to {sheet.place(rows[-1], column)})"
        expected = f"one or one for each of the {len(modules.rows)} modules of sheet {modules.sheet.name}"
        raise InputError(f"{sheet.book.path.name}: {has} {places}, expected {expected}")
    return table.rows


def _labels(sheet: Sheet, rows: tuple[int, ...], column: int) -> tuple[Label, ...]:
    values = [sheet.value(row, column) for row in rows]
    labels: list[Label | None] = [module_number(value) for value in values]
    if all(type(value) is str for value in values) and None in labels:
        labels = [" ".join(str(value).split()) for value in values]
    first: dict[Label, int] = {}
    for row, label in zip(rows, labels, strict=True):
        where = sheet.where(row, column)
        if label is None:
            raise InputError(f"{where} {sheet.found(row, column)}, expected a module's number (or a name in every row)")
        if label in first:
            other = sheet.place(first[label], column)
            raise InputError(f"{where} is module {label}, as is {other}: expected another number")
        first[label] = row
    return tuple(first)
