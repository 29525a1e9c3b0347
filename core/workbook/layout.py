"""Which cells hold which quantity of which module, whether the headings say so or a column map."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, InputWarning
from .book import HEADING_ROWS, Book, Sheet, Uncomputed
from .cells import found, length, module_number, where
from .column_map import ColumnMap, MappedColumn, MappedTable
from .headings import heading_of, shows_as_stored
from .quantities import QUANTITIES

MAX_MODULES = 10_000

Label = int | str
"""What a row calls its module: a number, or a name such as "M01"."""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a sheet that belong to modules, and the columns of their quantities.

    Attributes
    ----------
    sheet : Sheet
    columns : dict
        Quantity -> column and unit.
    rows : tuple of int
    label_column : int or None
        The column of the modules' numbers or names.
    labels : tuple of Label, or None
        What stands in it.
    """

    sheet: Sheet
    columns: dict[str, tuple[int, str]]
    rows: tuple[int, ...]
    label_column: int | None = None
    labels: tuple[Label, ...] | None = field(init=False)

    def __post_init__(self) -> None:
        column = self.label_column
        object.__setattr__(self, "labels", None if column is None else _labels(self.sheet, self.rows, column))

    @cached_property
    def numbers(self) -> tuple[int, ...] | None:
        """The modules' numbers, where the table has numbers."""
        labels = self.labels
        return None if labels is None or any(isinstance(x, str) for x in labels) else tuple(map(int, labels))

    @property
    def number_column(self) -> int | None:
        """The column of the modules' numbers, where the table has numbers."""
        return None if self.numbers is None else self.label_column

    @cached_property
    def names(self) -> tuple[int, ...]:
        """The modules' numbers: those of the table, or 1, 2, ..."""
        return self.numbers or tuple(range(1, len(self.rows) + 1))


class Column:
    """The cells of one quantity, one for each module.

    Attributes
    ----------
    table : Table
    quantity : str
    modules : Table
        The first, with a row for each module.
    rows : tuple of int
        The row of each module; the same where one cell stands for all.
    column : int
    unit : str
        Of the numbers in the cells.
    factor : float
        The unit in mm or rad.
    shared : bool
        Whether one cell holds the quantity of several modules.
    """

    def __init__(self, table: Table, quantity: str, modules: Table, rows: tuple[int, ...]) -> None:
        self.table, self.quantity, self.modules, self.rows = table, quantity, modules, rows
        self.column, self.unit = table.columns[quantity]
        self.factor = QUANTITIES[quantity].units[self.unit]
        self.shared = len(rows) > 1 and len(set(rows)) == 1

    def where(self, i: int) -> str:
        """File, sheet and cell of module index `i`."""
        return where(self.table.sheet, self.rows[i], self.column)

    def place(self, i: int) -> str:
        """Sheet and cell of module index `i`."""
        return self.table.sheet.place(self.rows[i], self.column)

    def given(self) -> NDArray[np.float64]:
        """The numbers (M,) as they stand in the cells; a cell without one is refused."""
        return np.array([self._number(i) for i in range(len(self.rows))])

    def given_or_nan(self, may_fail: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """The numbers (M,) in the cells, NaN where blank or not computable, and where no number but `may_fail`."""
        numbers = np.full(len(self.rows), math.nan)
        for i, row in enumerate(self.rows):
            value = self.table.sheet.value(row, self.column)
            optional = value is None or isinstance(value, Uncomputed) or (may_fail is not None and may_fail[i])
            if isinstance(value, float) or not optional:
                numbers[i] = self._number(i)
        return numbers

    def _number(self, i: int) -> float:
        of = "" if self.shared else f" of module {self.modules.names[i]}"
        return length(self.table.sheet, self.rows[i], self.column, self.quantity, of)

    def refuse(self, bad: NDArray[np.bool_], why: Callable[[int], str]) -> None:
        """Refuse the first module of `bad` (M,)."""
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(f"{self.where(i)} {why(i)}")


@dataclass(frozen=True, eq=False)
class Layout:
    """Where a workbook's numbers stand.

    Attributes
    ----------
    modules : Table
        The table of x1, y1, z1.
    columns : dict
        Quantity -> `Column`, of each that has one.
    rows_of : dict
        Table -> the row of each module in it, of those tables that have a row for each.
    """

    modules: Table
    columns: dict[str, Column]
    rows_of: dict[Table, tuple[int, ...]]


def mapped_layout(book: Book, columns: ColumnMap) -> Layout:
    """The layout that a complete column map states."""
    tables = [_mapped_table(book, table) for table in columns.tables]
    modules, layout = tables[0], Layout(tables[0], {}, {tables[0]: tables[0].rows})
    check_modules(modules)
    for table, said in zip(tables, columns.tables, strict=True):
        rows = modules.rows
        if said.rows == "one for all":
            rows = (table.rows[0],) * len(modules.rows)
        elif said.rows == "in order":
            rows = layout.rows_of[table] = in_order(modules, table)
        elif said.rows == "by number":
            if modules.labels is None:
                raise InputError(
                    f"{book.path.name}: the column map joins the rows of sheet {said.sheet} by number, but its first "
                    "table has no number, expected the column of the modules' numbers there"
                )
            rows = layout.rows_of[table] = by_label(modules, table)
        for name in table.columns:
            layout.columns[name] = Column(table, name, modules, rows)
    return layout


def _mapped_table(book: Book, said: MappedTable) -> Table:
    from openpyxl.utils import column_index_from_string as index

    if said.sheet not in book.sheets:
        raise InputError(
            f"{book.path.name}: has no sheet {said.sheet}, which the column map names; its sheets are "
            f"{', '.join(book.sheets)}"
        )
    columns = {c.quantity: (index(c.column), c.unit) for c in said.columns}
    number = None if said.number is None else index(said.number)
    table = Table(book.sheets[said.sheet], columns, said.row_numbers(), number)
    _warn_of_contradictions(table)
    return table


def _warn_of_contradictions(table: Table) -> None:
    """Warn of the first heading or number format of a mapped column that says another unit or quantity than the map."""
    sheet, first = table.sheet, table.rows[0]
    for name, (column, unit) in table.columns.items():
        for row in range(max(1, first - HEADING_ROWS), first):
            heading = heading_of(sheet.texts.get((row, column)))
            if heading is not None and (heading.quantity != name or heading.unit not in (None, unit)):
                said = heading.quantity + (f" in {heading.unit}" if heading.unit else "")
                warnings.warn(
                    f"{where(sheet, row, column)} says {said}, the column map {name} in {unit}, which is used",
                    InputWarning,
                    stacklevel=2,
                )
                return
        shown = sheet.number_format(first, column) if (first, column) in sheet.cells else ""
        if not shows_as_stored(shown, unit):
            warnings.warn(
                f"{where(sheet, first, column)} is shown as {shown!r}, the column map says {name} in {unit}, which is used",
                InputWarning,
                stacklevel=2,
            )
            return


def column_map_of(layout: Layout, rows_of: dict[Table, tuple[int, ...]] | None = None) -> ColumnMap:
    """The map that states a layout; `rows_of` gives tables other rows than they have."""
    from openpyxl.utils import get_column_letter as letters

    said = []
    for table in dict.fromkeys([layout.modules, *(column.table for column in layout.columns.values())]):
        columns = {name: c for name, c in layout.columns.items() if c.table is table}
        rows = {**layout.rows_of, **(rows_of or {})}.get(table, table.rows)
        shared = {name for name, c in columns.items() if c.shared or (table is not layout.modules and len(rows) == 1)}
        number = None if table.label_column is None else letters(table.label_column)
        joined = None if table is layout.modules else "by number" if number and layout.modules.labels else "in order"
        for names, how in ((columns.keys() - shared, joined), (shared, "one for all")):
            used = sorted(rows) if how != "one for all" else [columns[name].rows[0] for name in names][:1]
            if not names:
                continue
            said.append(
                MappedTable(
                    sheet=table.sheet.name,
                    first_row=used[0],
                    last_row=used[-1],
                    columns=tuple(
                        MappedColumn(name, letters(c.column), c.unit) for name, c in columns.items() if name in names
                    ),
                    number=number if how != "one for all" else None,
                    rows=how,  # type: ignore[arg-type]
                    skip_rows=tuple(sorted(set(range(used[0], used[-1])) - set(used))),
                )
            )
    return ColumnMap(tuple(said))


def check_modules(modules: Table) -> None:
    """Refuse a table of modules that is empty or too long."""
    sheet = modules.sheet
    if not modules.rows:
        raise InputError(f"{sheet.book.path.name}: sheet {sheet.name} has no modules, expected rows with x1, y1, z1")
    if len(modules.rows) > MAX_MODULES:
        raise InputError(
            f"{sheet.book.path.name}: sheet {sheet.name} has {len(modules.rows)} modules, expected at most {MAX_MODULES}"
        )


def by_label(modules: Table, table: Table) -> tuple[int, ...]:
    """The row of each module in `table`, by what both call it; modules that only `table` has are warned of."""
    assert modules.labels is not None and table.labels is not None, "asked only of tables with labels"
    row_of = dict(zip(table.labels, table.rows, strict=True))
    for label, row in zip(modules.labels, modules.rows, strict=True):
        if label not in row_of:
            raise InputError(
                f"{where(modules.sheet, row, modules.label_column or 1)} is module {label}, expected a row of it in "
                f"sheet {table.sheet.name} too, with its {', '.join(table.columns)}"
            )
    extra = [label for label in table.labels if label not in set(modules.labels)]
    if extra:
        more = f" and {len(extra) - 1} more modules" if len(extra) > 1 else ""
        warnings.warn(
            f"{where(table.sheet, row_of[extra[0]], table.label_column or 1)} has module {extra[0]}{more} without "
            f"coordinates in sheet {modules.sheet.name}: left out",
            InputWarning,
            stacklevel=2,
        )
    return tuple(row_of[label] for label in modules.labels)


def in_order(modules: Table, table: Table) -> tuple[int, ...]:
    """The row of each module in `table`, row by row."""
    if len(table.rows) != len(modules.rows):
        name, (column, _) = next(iter(table.columns.items()))
        sheet, rows = table.sheet, table.rows
        raise InputError(
            f"{sheet.book.path.name}: sheet {sheet.name} has {len(rows)} rows of {name} ({sheet.place(rows[0], column)} "
            f"to {sheet.place(rows[-1], column)}), expected one or one for each of the {len(modules.rows)} modules of "
            f"sheet {modules.sheet.name}"
        )
    return table.rows


def _labels(sheet: Sheet, rows: tuple[int, ...], column: int) -> tuple[Label, ...]:
    values = [sheet.value(row, column) for row in rows]
    labels: list[Label | None] = [module_number(value) for value in values]
    if all(type(value) is str for value in values) and None in labels:
        labels = [" ".join(str(value).split()) for value in values]
    first: dict[Label, int] = {}
    for row, label in zip(rows, labels, strict=True):
        if label is None:
            raise InputError(
                f"{where(sheet, row, column)} {found(sheet, row, column)}, expected a module's number (or a name in "
                "every row)"
            )
        if label in first:
            raise InputError(
                f"{where(sheet, row, column)} is module {label}, as is {sheet.place(first[label], column)}: "
                "expected another number"
            )
        first[label] = row
    return tuple(label for label in labels if label is not None)
