"""Which cells hold which quantity of which module, whether the headings say so or a column map."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, warn
from .book import HEADING_ROWS, Book, Sheet, module_number
from .calculation import Uncomputed
from .column_map import ColumnMap
from .headings import heading_of, shows_as_stored
from .quantities import QUANTITIES

MAX_MODULES = 10_000

Label = int | str
"""What a row calls its module: a number, or a name such as "M01"."""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a sheet that hold modules; `columns` is quantity -> column and unit.

    `labels` has what the rows call their modules in the `label_column`; `InputError` if that does not tell them apart.
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


class Column:
    """The cells of one quantity; `factor` is their unit in mm or rad.

    `rows` has the row of each module of the table of `modules`, all the same if one cell holds for all (`shared`).
    """

    def __init__(self, table: Table, quantity: str, modules: Table, rows: tuple[int, ...]) -> None:
        self.table, self.quantity, self.modules, self.rows = table, quantity, modules, rows
        self.column, self.unit = table.columns[quantity]
        self.factor = QUANTITIES[quantity].units[self.unit]
        self.shared = len(rows) > 1 and len(set(rows)) == 1

    def where(self, i: int) -> str:
        """File, sheet and cell of module index `i`."""
        return self.table.sheet.where(self.rows[i], self.column)

    def place(self, i: int) -> str:
        """Sheet and cell of module index `i`."""
        return self.table.sheet.place(self.rows[i], self.column)

    def numbers(self, optional: bool = False, ignored: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """The numbers (M,) in the cells, in their unit; `InputError` if one holds no number.

        NaN where they are `ignored`, or where a cell is blank or cannot be computed if they are `optional`.
        """
        numbers, sheet = np.full(len(self.rows), math.nan), self.table.sheet
        for i, row in enumerate(self.rows):
            if ignored is not None and ignored[i]:
                continue
            value = sheet.value(row, self.column)
            absent = value is None or isinstance(value, Uncomputed)
            if isinstance(value, float) and math.isfinite(value) and not sheet.is_date(row, self.column):
                numbers[i] = value
            elif isinstance(value, float) or not (optional and absent):
                of = "" if self.shared else f" of module {self.modules.module_numbers[i]}"
                found = sheet.found(row, self.column)
                raise InputError(f"{self.where(i)} {found}, expected {self.quantity}{of}, a number")
        return numbers

    def refuse(self, bad: NDArray[np.bool_], why: Callable[[int], str]) -> None:
        """Raise `InputError` for the first module of `bad` (M,), if any."""
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(f"{self.where(i)} {why(i)}")


@dataclass(frozen=True, eq=False)
class Layout:
    """Where a workbook's numbers are.

    `modules` is the table of x1, y1, z1; `rows_of` has the row of each module in every table with a row for each.
    """

    modules: Table
    columns: dict[str, Column] = field(default_factory=dict)
    rows_of: dict[Table, tuple[int, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sheet, rows = self.modules.sheet, self.modules.rows
        where = f"{sheet.book.path.name}: sheet {sheet.name} has"
        if not rows:
            raise InputError(f"{where} no modules, expected rows with x1, y1, z1")
        if len(rows) > MAX_MODULES:
            raise InputError(f"{where} {len(rows)} modules, expected at most {MAX_MODULES}")
        self.rows_of[self.modules] = rows


def mapped_layout(book: Book, columns: ColumnMap) -> Layout:
    """The layout that a complete column map describes."""
    from openpyxl.utils import column_index_from_string as index

    tables = []
    for said in columns.tables:
        if said.sheet not in book.sheets:
            raise InputError(
                f"{book.path.name}: has no sheet {said.sheet}, which the column map names; its sheets are "
                f"{', '.join(book.sheets)}"
            )
        cells = {c.quantity: (index(c.column), c.unit) for c in said.columns}
        number = None if said.number is None else index(said.number)
        tables.append(Table(book.sheets[said.sheet], cells, said.row_numbers(), number))
        for contradiction in itertools.islice(_contradictions(tables[-1]), 1):
            warn(contradiction, 2)
    modules, layout = tables[0], Layout(tables[0])
    for table, said in zip(tables, columns.tables, strict=True):
        rows = modules.rows
        if said.rows == "one for all":
            rows = (table.rows[0],) * len(modules.rows)
        elif said.rows == "in order":
            rows = layout.rows_of[table] = in_order(modules, table)
        elif said.rows == "by number":
            if modules.labels is None:
                raise InputError(
                    f"{book.path.name}: the column map matches the rows of sheet {said.sheet} by number, but its first "
                    "table has no number, expected the column of the modules' numbers there"
                )
            rows = layout.rows_of[table] = by_label(modules, table)
        for name in table.columns:
            layout.columns[name] = Column(table, name, modules, rows)
    return layout


def _contradictions(table: Table) -> Iterator[str]:
    """The headings and number formats of mapped columns that say another unit or quantity than the map."""
    sheet, first = table.sheet, table.rows[0]
    for name, (column, unit) in table.columns.items():
        used = f"the column map says {name} in {unit}, which is used"
        for row in range(max(1, first - HEADING_ROWS), first):
            heading = heading_of(sheet.texts.get((row, column), ""))
            if heading is not None and (heading.quantity != name or heading.unit not in (None, unit)):
                said = heading.quantity + (f" in {heading.unit}" if heading.unit else "")
                yield f"{sheet.where(row, column)} says {said}, {used}"
        shown = sheet.number_format(first, column)
        if not shows_as_stored(shown, unit):
            yield f"{sheet.where(first, column)} is shown as {shown!r}, {used}"


def by_label(modules: Table, table: Table) -> tuple[int, ...]:
    """The row of each module in `table`, by what both call it; a warning is given of modules only `table` has."""
    assert modules.labels is not None and table.labels is not None, "asked only of tables with labels"
    row_of = dict(zip(table.labels, table.rows, strict=True))
    for label, row in zip(modules.labels, modules.rows, strict=True):
        if label not in row_of:
            raise InputError(
                f"{modules.sheet.where(row, modules.label_column or 1)} is module {label}, expected a row for it in "
                f"sheet {table.sheet.name} too, with its {', '.join(table.columns)}"
            )
    extra = [label for label in table.labels if label not in set(modules.labels)]
    if extra:
        more = f" and {len(extra) - 1} more modules" if len(extra) > 1 else ""
        warn(
            f"{table.sheet.where(row_of[extra[0]], table.label_column or 1)} has module {extra[0]}{more} without "
            f"coordinates in sheet {modules.sheet.name}: left out",
            2,
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
        where = sheet.where(row, column)
        if label is None:
            raise InputError(f"{where} {sheet.found(row, column)}, expected a module's number (or a name in every row)")
        if label in first:
            raise InputError(
                f"{where} is module {label}, as is {sheet.place(first[label], column)}: expected another number"
            )
        first[label] = row
    return tuple(first)
