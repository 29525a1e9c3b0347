"""Column map: a table, kept as TOML, in which a person says what the cells of a workbook hold if its headings do not."""

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
from .headings import parse_unit
from .sheet_xml import MAX_COLUMN, MAX_ROW

RowMatching = Literal["by number", "in order", "one for all"]
"""Rule by which the rows of a table are matched with the rows of the first table."""

_HELP = "see docs/workbook.md"
_KEYS = {"sheet": str, "header_row": int, "first_row": int, "last_row": int, "skip_rows": list}
_KEYS |= {"rows": str, "number": str, "columns": dict}


@dataclass(frozen=True)
class MappedColumn:
    """Column of a sheet that holds a column of the scanner."""

    quantity: str
    """Name of the scanner's column, such as x1, Td or azimuth."""
    column: str
    """Letters of the sheet's column."""
    unit: str
    """mm, cm, m, in, µm, dm, ft, mil or 0.1 mm; rad or deg. Empty for texts and plain numbers, and in a draft if unknown."""

    def __post_init__(self) -> None:
        """Replace a word for a unit, such as "um" or "inches", by the unit."""
        object.__setattr__(self, "unit", parse_unit(self.unit) or self.unit)


@dataclass(frozen=True)
class MappedTable:
    """Rows of a sheet, and the columns in them. Every row from the first to the last that is not skipped holds a module."""

    sheet: str
    first_row: int
    last_row: int
    columns: tuple[MappedColumn, ...]
    number: str | None = None
    """Letters of the column with the modules' numbers or names. Without it, the first table's modules are 1, 2, ..."""
    rows: RowMatching | None = None
    """Matching of the rows with those of the first table: by the contents of the two `number` columns, in the same
    order, or one row for all modules. None in the first table itself."""
    header_row: int | None = None
    """Row of the headings, a note for people that is not read."""
    skip_rows: tuple[int, ...] = ()
    """Rows between the first and the last that do not belong to the table."""

    def row_numbers(self) -> tuple[int, ...]:
        """Return the rows of the modules, ascending."""
        skipped = set(self.skip_rows)
        return tuple(row for row in range(self.first_row, self.last_row + 1) if row not in skipped)

    def with_rows(self, rows: Sequence[int]) -> MappedTable:
        """Return the table with other rows, given in ascending order."""
        skipped = sorted(set(range(rows[0], rows[-1])).difference(rows))
        return replace(self, first_row=rows[0], last_row=rows[-1], skip_rows=tuple(skipped))


@dataclass(frozen=True)
class ColumnMap:
    """Map from cells of a workbook to columns of a scanner, given by a person instead of the workbook's headings.

    Of pinholes, the first of the `tables` holds x1, y1 and z1; d, R, Ld and Td must be in some table; without l, the design
    formula is used. A map read by `from_toml` or `read` may be incomplete: `faults` lists what is missing.
    """

    tables: tuple[MappedTable, ...]

    def faults(self, kind: str = "pinhole") -> list[str]:
        """Return why the map cannot be used for a kind of scanner, a line for each reason; empty if it is complete."""
        definitions = scanner_kind(kind).columns
        leading = definitions.position or (definitions.leading,)
        if not self.tables:
            return [f"the column map has no [[tables]], expected one with {', '.join(leading)} first"]
        faults = [fault for i, table in enumerate(self.tables) for fault in _find_table_faults(table, i, definitions)]
        table_of: dict[str, str] = {}  # quantity -> name of the table that has it
        for i, table in enumerate(self.tables):
            for c in table.columns:
                if c.quantity in table_of:
                    faults.append(f"{_key(i, c.quantity)} is in {table_of[c.quantity]} too, expected it in one table")
                table_of.setdefault(c.quantity, _key(i))
        for name in leading:
            if table_of.get(name) != _key(0):
                has = f"{table_of[name]} has {name}" if name in table_of else f"{_key(0)} has no column {name}"
                faults.append(f"{has}, expected {', '.join(leading)} in the first table")
        if missing := [name for name in definitions.needed if name not in {*table_of, *leading}]:
            faults.append(f"no table has {'a column' if len(missing) == 1 else 'the columns'} {', '.join(missing)}")
        # Tables with common rows may share a column only if it has the modules' numbers.
        uses_of_column: dict[tuple[str, str], list[tuple[set[int], str]]] = {}
        for i, table in enumerate(self.tables):
            rows = set(range(max(table.first_row, 1), min(table.last_row, MAX_ROW) + 1))
            names = [(c.quantity, c.column) for c in table.columns]
            names += [("number", table.number)] if table.number else []
            for name, column in names:
                uses = uses_of_column.setdefault((table.sheet.casefold(), column), [])
                for used_rows, use in uses:
                    if rows & used_rows and not (name == "number" and use.endswith(".number")):
                        faults.append(f"{_key(i, name)}: column {column} is {use} too, expected another column")
                uses.append((rows, _key(i, name)))
        return faults

    def to_toml(self) -> str:
        """Return the map as TOML text, which `from_toml` reads."""
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
        """Return the map in a TOML text, called `name` in messages; raise `InputError` for unknown keys or values."""
        return cls._from_values(parse_toml(text, name), name)

    @classmethod
    def read(cls, path: AnyPath) -> ColumnMap:
        """Return the map in a TOML file; raise `InputError` if it cannot be read."""
        return cls._from_values(read_toml(path), str(path))

    @classmethod
    def _from_values(cls, values: dict[str, Any], name: str) -> ColumnMap:
        """Return the map with these parsed TOML values; `name` is its name in messages."""
        _check_keys(values, {"tables": list}, name)
        tables = values.get("tables", [None])
        if not all(isinstance(table, dict) for table in tables):
            raise InputError(f"{name}: expected [[tables]] ({_HELP})")
        return cls(tuple(_table_from_values(table, f"{name}: {_key(i)}") for i, table in enumerate(tables)))

    def write(self, path: AnyPath, comment: str = "") -> None:
        """Write the map to a .toml file, with the lines of `comment` as TOML comments above it."""
        lines = "".join(f"# {line}\n" for line in comment.splitlines())
        write_bytes(path, (lines + self.to_toml()).encode())


def load_column_map(columns: ColumnMap | AnyPath | None, workbook: AnyPath, scanner: type[Scanner]) -> ColumnMap | None:
    """Return the column map of `workbook` for a kind of scanner, from its file if `columns` is a path.

    Returns None without `columns`; raises `InputError` for an incomplete map.
    """
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


def _key(i: int, name: str = "") -> str:
    """Return the name in messages of table `i`, counted from 0, or of a key or column in it, such as "table 2.d"."""
    return f"table {i + 1}" + (f".{name}" if name else "")


def _find_table_faults(table: MappedTable, i: int, definitions: ColumnTable) -> Iterator[str]:
    """Yield a line for each reason why table `i` of a column map cannot be used."""
    if not 1 <= table.first_row <= table.last_row <= MAX_ROW:
        yield f"{_key(i)}: rows {table.first_row} to {table.last_row}, expected the first row, then the last"
    elif not table.row_numbers():
        yield f"{_key(i)}: skip_rows leaves no row"
    for row in table.skip_rows:
        if not table.first_row < row < table.last_row:
            yield f"{_key(i)}: skip_rows has {row}, expected rows between {table.first_row} and {table.last_row}"
    if not table.columns:
        yield f"{_key(i)} has no columns"
    alike: dict[tuple[str, tuple[str, ...]], list[str]] = {}  # unit and the expected ones -> quantities
    for c in table.columns:
        if (definition := definitions.get(c.quantity)) is None:
            yield f"{_key(i, c.quantity)}: no such quantity, expected {', '.join(definitions)}"
        elif c.unit not in definition.units:
            alike.setdefault((c.unit, tuple(definition.units)), []).append(c.quantity)
        if not _is_column_letters(c.column):
            yield f"{_key(i, c.quantity)}: column {c.column!r}, expected letters such as B"
    for (unit, expected), names in alike.items():
        yield f"{_key(i, ', '.join(names))}: unit {unit!r}, expected {', '.join(filter(None, expected)) or 'none'}"
    if table.number is not None and not _is_column_letters(table.number):
        yield f"{_key(i)}: number {table.number!r}, expected a column's letters such as A"
    if i == 0 and table.rows is not None:
        yield f"{_key(0)} has rows = {table.rows!r}, which only the tables after the first may have"
    if i > 0 and table.rows not in get_args(RowMatching):
        yield f"{_key(i)}: rows = {table.rows!r}, expected {' or '.join(map(repr, get_args(RowMatching)))}"
    if i > 0 and table.rows == "by number" and table.number is None:
        yield f"{_key(i)}: rows = 'by number' without number, expected the column of the numbers"
    if table.rows == "one for all" and len(table.row_numbers()) != 1:
        yield f"{_key(i)}: rows = 'one for all' of several rows, expected first_row = last_row"


def _is_column_letters(letters: str) -> bool:
    """Return whether a text is the letters of a column that a sheet can have."""
    from openpyxl.utils import column_index_from_string

    return bool(re.fullmatch("[A-Z]{1,3}", letters)) and column_index_from_string(letters) <= MAX_COLUMN


def _check_keys(values: dict[str, Any], kinds: dict[str, type], where: str) -> None:
    """Raise `InputError` for a key that is not in `kinds`, or whose value is not of the type there; `where` is its place."""
    words = {int: "a whole number", str: "text in quotes", dict: "a table", list: "a list"}
    for key, value in values.items():
        if key not in kinds:
            raise InputError(f"{where}: unknown key {key!r}, expected {', '.join(sorted(kinds))}")
        if type(value) is not kinds[key]:
            raise InputError(f"{where}: {key} = {value!r}, expected {words[kinds[key]]}")


def _table_from_values(values: dict[str, Any], where: str) -> MappedTable:
    """Return the table with these parsed TOML values; `where` names it in messages."""
    _check_keys(values, _KEYS, where)
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
            _check_keys(column, {"column": str, "unit": str}, f"{where}.{name}")
        if not isinstance(column, dict) or len(column) < 2:
            raise InputError(f'{where}.{name}: expected {{ column = "B", unit = "mm" }}')
        columns.append(MappedColumn(name, column["column"].upper(), column["unit"]))
    number = values["number"].upper() if "number" in values else None
    return MappedTable(**{**values, "columns": tuple(columns), "number": number, "skip_rows": skipped})
