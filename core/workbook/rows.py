"""Which rows of a table hold the modules, and which cell holds a quantity of a module."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from ..errors import InputError, InputWarning
from .book import Uncomputed
from .cells import found, module_number, where
from .formulas import CellError
from .headings import DIMENSIONS, POSITION, Table, quantity_of
from .workbook_xml import areas_in

MAX_MODULES = 10_000


@dataclass(frozen=True)
class Rows:
    """The rows of a table that hold values, and the modules' numbers in them where the table has numbers.

    Attributes
    ----------
    table : Table
    rows : tuple of int
    number_column : int or None
    numbers : tuple of int, or None
    """

    table: Table
    rows: tuple[int, ...]
    number_column: int | None
    numbers: tuple[int, ...] | None

    @property
    def names(self) -> tuple[int, ...]:
        """The modules' numbers: those of the table, or 1, 2, ..."""
        return self.numbers or tuple(range(1, len(self.rows) + 1))


def module_rows(table: Table) -> Rows:
    """The modules of the coordinates' table, notes and blank rows left out."""
    columns = [table.column(name) for name in POSITION]
    rows = _rows(table, [column for column in columns if column is not None])
    if len(rows.rows) > MAX_MODULES:
        raise InputError(
            f"{table.sheet.book.path.name}: sheet {table.sheet.name} has {len(rows.rows)} modules, "
            f"expected at most {MAX_MODULES}"
        )
    if rows.numbers is not None:
        _refuse_repeated(rows)
    return rows


def dimension_rows(table: Table) -> Rows:
    """The rows of a table of dimensions that hold any."""
    return _rows(table, sorted({column for _, column, quantity in table.headings if quantity in DIMENSIONS}))


def rows_of_modules(quantity: str, modules: Rows, table: Table) -> tuple[int, ...]:
    """The row of `table` that holds `quantity` of each of `modules`.

    Rows go by the modules' numbers where both tables have them, else by their order; a single value, in the
    table's first row, stands for all modules.
    """
    column = table.column(quantity)
    assert column is not None, "asked only of tables that have the quantity"
    sheet, n = table.sheet, len(modules.rows)
    rows = modules if table is modules.table else dimension_rows(table)
    if not rows.rows:
        raise InputError(f"{where(sheet, table.first_row, column)} is blank, expected {quantity}, a number")
    filled = [row for row in rows.rows if sheet.value(row, column) is not None]
    if filled == [rows.rows[0]]:
        return (rows.rows[0],) * n
    if rows is modules:
        return modules.rows
    if rows.numbers is not None and modules.numbers is not None:
        _refuse_repeated(rows)
        row_of = dict(zip(rows.numbers, rows.rows, strict=True))
        for number, row in zip(modules.numbers, modules.rows, strict=True):
            if number not in row_of:
                at = where(modules.table.sheet, row, modules.number_column or 1)
                raise InputError(
                    f"{at} is module {number}, expected a row with its {quantity} in sheet {sheet.name} too"
                )
        return tuple(row_of[number] for number in modules.numbers)
    if len(rows.rows) != n:
        raise InputError(
            f"{sheet.book.path.name}: sheet {sheet.name} has {len(rows.rows)} rows of {quantity} "
            f"({sheet.place(rows.rows[0], column)} to {sheet.place(rows.rows[-1], column)}), expected one "
            f"or one for each of the {n} modules of sheet {modules.table.sheet.name}"
        )
    return rows.rows


def warn_of_left_out(modules: Rows, table: Table) -> None:
    """Warn of numbered modules that `table` has and `modules` lacks."""
    if table is modules.table or modules.numbers is None:
        return
    rows = dimension_rows(table)
    known = set(modules.numbers)
    extra = [i for i, number in enumerate(rows.numbers or ()) if number not in known]
    if extra and len(rows.rows) > 1:
        assert rows.numbers is not None and rows.number_column is not None
        more = f" and {len(extra) - 1} more modules" if len(extra) > 1 else ""
        warnings.warn(
            f"{where(table.sheet, rows.rows[extra[0]], rows.number_column)} has module "
            f"{rows.numbers[extra[0]]}{more} without coordinates in sheet {modules.table.sheet.name}: left out",
            InputWarning,
            stacklevel=3,
        )


def _rows(table: Table, columns: list[int]) -> Rows:
    sheet = table.sheet
    candidates = [row for row in sheet.rows if row >= table.first_row]
    below = [row for row in candidates if not _is_note(table, row, columns)]
    number_column = _number_column(table, below)
    if number_column is None:
        return Rows(table, tuple(row for row in below if not _is_summary(table, row, columns)), None, None)
    # A number without values is a row too: its blank cells are to be refused, not the module to be dropped.
    valued = set(below)
    rows = [row for row in candidates if row in valued or module_number(sheet.value(row, number_column)) is not None]
    numbers: dict[int, int] = {}
    for row in rows:
        number = module_number(sheet.value(row, number_column))
        if number is None:
            if len(rows) == 1:
                return Rows(table, tuple(rows), None, None)
            if _is_summary(table, row, columns):
                continue
            at = where(sheet, row, number_column)
            raise InputError(f"{at} {found(sheet, row, number_column)}, expected a module's number")
        numbers[row] = number
    return Rows(table, tuple(numbers), number_column, tuple(numbers.values()))


def _is_note(table: Table, row: int, columns: list[int]) -> bool:
    """Whether a row is none of the table's: nothing in `columns`, one text alone, headings or units again."""
    filled = [value for column in columns if (value := table.sheet.value(row, column)) is not None]
    texts = [v for v in filled if isinstance(v, str) and not isinstance(v, (CellError, Uncomputed))]
    if len(texts) < len(filled):
        return False
    alone = len(texts) <= 1 and len(columns) > 1
    return alone or not texts or all(quantity_of(t) or t.strip(" ()[]").casefold() == "mm" for t in texts)


def _is_summary(table: Table, row: int, columns: list[int]) -> bool:
    """Whether a row sums up others, as AVERAGE(B3:B82) below a column: one of `columns` refers to several rows of itself."""
    return any(
        area.top < area.bottom and area.left <= column <= area.right and area.sheet in (None, table.sheet.name)
        for column in columns
        for area in areas_in(table.sheet.formulas.get((row, column), "="))
    )


def _number_column(table: Table, rows: list[int]) -> int | None:
    """The column of the modules' numbers: the first in question with nothing but different numbers in `rows`.

    Failing that, the first that is headed so or has different numbers in most rows, faults to be refused.
    """
    headed = {column for _, column, quantity in table.headings if quantity == "number"}
    partly = None
    for column in table.number_columns():
        numbers = [module_number(table.sheet.value(row, column)) for row in rows]
        different = set(numbers) - {None}
        if rows and len(different) == len(rows):
            return column
        if partly is None and different and (column in headed or 2 * len(different) > len(rows)):
            partly = column
    return partly


def _refuse_repeated(rows: Rows) -> None:
    first: dict[int, int] = {}
    assert rows.numbers is not None and rows.number_column is not None
    for number, row in zip(rows.numbers, rows.rows, strict=True):
        if number in first:
            sheet, column = rows.table.sheet, rows.number_column
            raise InputError(
                f"{where(sheet, row, column)} is module {number}, as is {sheet.place(first[number], column)}: "
                "expected another number"
            )
        first[number] = row
