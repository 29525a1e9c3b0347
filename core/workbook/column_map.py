"""A column map: what a person says about the cells of a workbook where its headings do not. Kept as TOML."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from ..errors import InputError
from ..files import AnyPath, write_bytes
from ..geometry.columns import ColumnTable
from ..geometry.scanner import Scanner
from ..recipes.toml import parse_toml, read_toml, toml_value
from ..scanner_kinds import scanner_kind
from .headings import unit_of
from .sheet_xml import MAX_COLUMN, MAX_ROW

Joined = Literal["by number", "in order", "one for all"]

_HELP = "see docs/workbook.md"
_KEYS = {"sheet": str, "header_row": int, "first_row": int, "last_row": int, "skip_rows": list}
_KEYS |= {"rows": str, "number": str, "columns": dict}


@dataclass(frozen=True)
class MappedColumn:
    """A column of a sheet: the name of the scanner's column in it, such as x1, Td or azimuth, its letters and the unit."""

    quantity: str
    column: str
    unit: str
    """mm, cm, m, in, µm, dm, ft, mil or 0.1 mm; rad or deg. Empty for texts and plain numbers, and in a draft if unknown."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", unit_of(self.unit) or self.unit)  # "um" and "inches" are units, too


@dataclass(frozen=True)
class MappedTable:
    """Rows of a sheet, and what their columns hold. Every row from the first to the last holds a module."""

    sheet: str
    first_row: int
    last_row: int
    columns: tuple[MappedColumn, ...]
    number: str | None = None
    """Letters of the column with the modules' numbers or names. Without it, the first table's modules are 1, 2, ..."""
    rows: Joined | None = None
    """How the rows are matched with those of the first table: by the contents of the two `number` columns, in the same
    order, or one row for all modules. None in the first table itself."""
    header_row: int | None = None
    """For people."""
    skip_rows: tuple[int, ...] = ()
    """Rows between the first and the last that do not belong to the table."""

    def row_numbers(self) -> tuple[int, ...]:
        """The rows of the modules."""
        skipped = set(self.skip_rows)
        return tuple(row for row in range(self.first_row, self.last_row + 1) if row not in skipped)

    def with_rows(self, rows: Sequence[int]) -> MappedTable:
        """The table with other rows, which are in ascending order."""
        skipped = sorted(set(range(rows[0], rows[-1])).difference(rows))
        return replace(self, first_row=rows[0], last_row=rows[-1], skip_rows=tuple(skipped))


@dataclass(frozen=True)
class ColumnMap:
    """Which cells of a workbook hold which column of a scanner, given by a person instead of its headings.

    Of pinholes, the first of the `tables` holds x1, y1 and z1; d, R, Ld and Td must be in some table; without l, the design
    formula is used. A map read by `from_toml` or `read` may be incomplete: `faults` lists what is missing.
    """

    tables: tuple[MappedTable, ...]

    def faults(self, kind: str = "pinhole") -> list[str]:
        """Why the map cannot be used for a kind of scanner, a line for each reason; empty if it is complete."""
        declared = scanner_kind(kind).columns
        first = declared.position or (declared.leading,)
        if not self.tables:
            return [f"the column map has no [[tables]], expected one with {', '.join(first)} first"]
        faults = [fault for i, table in enumerate(self.tables) for fault in _table_faults(table, i, declared)]
        places: dict[str, str] = {}
        for i, table in enumerate(self.tables):
            for c in table.columns:
                if c.quantity in places:
                    faults.append(f"{_of(i, c.quantity)} is in {places[c.quantity]} too, expected each quantity once")
                places.setdefault(c.quantity, _of(i))
        for name in first:
            if places.get(name) != _of(0):
                found = f"{places[name]} has {name}" if name in places else f"{_of(0)} has no column {name}"
                faults.append(f"{found}, expected {', '.join(first)} in the first table")
        faults += [f"no table has a column {name}" for name in declared.needed if name not in {*places, *first}]
        # A column may be used twice in the same rows only for the modules' numbers.
        used: dict[tuple[str, str], list[tuple[set[int], str]]] = {}
        for i, table in enumerate(self.tables):
            rows = set(range(max(table.first_row, 1), min(table.last_row, MAX_ROW) + 1))
            names = [(c.quantity, c.column) for c in table.columns]
            names += [("number", table.number)] if table.number else []
            for name, column in names:
                others = used.setdefault((table.sheet.casefold(), column), [])
                for other_rows, other in others:
                    if rows & other_rows and not (name == "number" and other.endswith(".number")):
                        faults.append(f"{_of(i, name)}: column {column} is {other} too, expected another column")
                others.append((rows, _of(i, name)))
        return faults

    def to_toml(self) -> str:
        """The map as text, which `from_toml` reads."""
        lines = []
        for table in self.tables:
            lines.append("[[tables]]")
            values = {key: getattr(table, key) for key in _KEYS if key != "columns"}
            lines += [f"{key} = {toml_value(value)}" for key, value in values.items() if value not in (None, ())]
            lines.append("[tables.columns]")
            for c in table.columns:
                lines.append(f"{c.quantity} = {{ column = {toml_value(c.column)}, unit = {toml_value(c.unit)} }}")
            lines.append("")
        return "\n".join(lines)

    @classmethod
    def from_toml(cls, text: str, name: str = "column map") -> ColumnMap:
        """The map in a TOML text; `InputError`, which calls it `name`, for unknown keys or values."""
        return cls._of_values(parse_toml(text, name), name)

    @classmethod
    def read(cls, path: AnyPath) -> ColumnMap:
        """The map in a TOML file; `InputError` if it cannot be read."""
        return cls._of_values(read_toml(path), str(path))

    @classmethod
    def _of_values(cls, values: dict[str, Any], name: str) -> ColumnMap:
        _refuse_others(values, {"tables": list}, name)
        tables = values.get("tables", [None])
        if not all(isinstance(table, dict) for table in tables):
            raise InputError(f"{name}: expected [[tables]] ({_HELP})")
        return cls(tuple(_table(table, f"{name}: {_of(i)}") for i, table in enumerate(tables)))

    def write(self, path: AnyPath, comment: str = "") -> None:
        """Write the map to a .toml file, below the lines of a comment."""
        lines = "".join(f"# {line}\n" for line in comment.splitlines())
        write_bytes(path, (lines + self.to_toml()).encode())


def column_map(columns: ColumnMap | AnyPath | None, workbook: AnyPath, scanner: type[Scanner]) -> ColumnMap | None:
    """The column map of `workbook` for a kind of scanner, given as such or by its file; `InputError` if incomplete."""
    if columns is None:
        return None
    name = str(columns)
    if isinstance(columns, ColumnMap):
        name = f"{Path(workbook).name}: column map"
    else:
        columns = ColumnMap.read(columns)
    for fault in columns.faults(scanner.kind):
        raise InputError(f"{name}: {fault} ({_HELP})")
    return columns


def _of(i: int, name: str = "") -> str:
    return f"table {i + 1}" + (f".{name}" if name else "")


def _table_faults(table: MappedTable, i: int, declared: ColumnTable) -> Iterator[str]:
    if not 1 <= table.first_row <= table.last_row <= MAX_ROW:
        yield f"{_of(i)}: rows {table.first_row} to {table.last_row}, expected the first row, then the last"
    elif not table.row_numbers():
        yield f"{_of(i)}: skip_rows leaves no row"
    for row in table.skip_rows:
        if not table.first_row < row < table.last_row:
            yield f"{_of(i)}: skip_rows has {row}, expected rows between {table.first_row} and {table.last_row}"
    if not table.columns:
        yield f"{_of(i)} has no columns"
    for c in table.columns:
        known = declared.get(c.quantity)
        if known is None:
            yield f"{_of(i, c.quantity)}: no such quantity, expected {', '.join(declared)}"
        elif c.unit not in known.units:
            yield f"{_of(i, c.quantity)}: unit {c.unit!r}, expected {', '.join(filter(None, known.units)) or 'none'}"
        if not _is_column(c.column):
            yield f"{_of(i, c.quantity)}: column {c.column!r}, expected letters such as B"
    if table.number is not None and not _is_column(table.number):
        yield f"{_of(i)}: number {table.number!r}, expected a column's letters such as A"
    if i == 0 and table.rows is not None:
        yield f"{_of(0)} has rows = {table.rows!r}, which only the tables after the first may have"
    if i > 0 and table.rows not in get_args(Joined):
        yield f"{_of(i)}: rows = {table.rows!r}, expected {' or '.join(map(repr, get_args(Joined)))}"
    if i > 0 and table.rows == "by number" and table.number is None:
        yield f"{_of(i)}: rows = 'by number' without number, expected the column of the numbers"
    if table.rows == "one for all" and len(table.row_numbers()) != 1:
        yield f"{_of(i)}: rows = 'one for all' of several rows, expected first_row = last_row"


def _is_column(letters: str) -> bool:
    from openpyxl.utils import column_index_from_string

    return bool(re.fullmatch("[A-Z]{1,3}", letters)) and column_index_from_string(letters) <= MAX_COLUMN


def _refuse_others(values: dict[str, Any], kinds: dict[str, type], where: str) -> None:
    """Raise `InputError` for keys and types of values that are not expected."""
    words = {int: "a whole number", str: "text in quotes", dict: "a table", list: "a list"}
    for key, value in values.items():
        if key not in kinds:
            raise InputError(f"{where}: unknown key {key!r}, expected {', '.join(sorted(kinds))}")
        if type(value) is not kinds[key]:
            raise InputError(f"{where}: {key} = {value!r}, expected {words[kinds[key]]}")


def _table(values: dict[str, Any], where: str) -> MappedTable:
    _refuse_others(values, _KEYS, where)
    if values.get("rows") == "one for all" and "first_row" in values:
        values = {"last_row": values["first_row"], **values}
    for key in ("sheet", "first_row", "last_row", "columns"):
        if key not in values:
            raise InputError(f"{where}: has no {key} ({_HELP})")
    skipped = tuple(values.get("skip_rows", []))
    if not all(type(row) is int for row in skipped):
        raise InputError(f"{where}: skip_rows = {list(skipped)}, expected whole numbers")
    columns = []
    for name, column in values["columns"].items():
        if isinstance(column, dict):
            _refuse_others(column, {"column": str, "unit": str}, f"{where}.{name}")
        if not isinstance(column, dict) or len(column) < 2:
            raise InputError(f'{where}.{name}: expected {{ column = "B", unit = "mm" }}')
        columns.append(MappedColumn(name, column["column"].upper(), column["unit"]))
    number = values["number"].upper() if "number" in values else None
    return MappedTable(**{**values, "columns": tuple(columns), "number": number, "skip_rows": skipped})
