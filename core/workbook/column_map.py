"""A column map: what a person says of a workbook that its headings do not say. Kept as TOML."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from ..errors import InputError
from ..files import replacing
from .headings import unit_of
from .quantities import NEEDED, POSITION, QUANTITIES
from .references import MAX_COLUMN, MAX_ROW

Joined = Literal["by number", "in order", "one for all"]

_LETTERS = re.compile("[A-Z]{1,3}")
_HELP = "see docs/workbook.md"


@dataclass(frozen=True)
class MappedColumn:
    """A column of one quantity.

    Attributes
    ----------
    quantity : str
        x1, y1, z1, d, R, Ld, Td; l, b, H, x2, y2, z2, range, azimuth or elevation.
    column : str
        Its letters.
    unit : str
        mm, cm, m, in, µm, dm, ft, mil or 0.1 mm; rad or deg. Empty in a draft where it is not known.
    """

    quantity: str
    column: str
    unit: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", unit_of(self.unit) or self.unit)  # "um" and "inches" are units, too


@dataclass(frozen=True)
class MappedTable:
    """Rows of a sheet, and what their columns hold.

    Attributes
    ----------
    sheet : str
    first_row, last_row : int
        Every row from one to the other is of a module, but for `skip_rows`.
    columns : tuple of MappedColumn
    number : str or None
        Letters of the column of the modules' numbers or names. Without, the first table's modules are 1, 2, ...
    rows : "by number", "in order", "one for all" or None
        How the rows belong to those of the first table: by what stands in the two `number` columns, in the same order,
        or one row for all modules. None in the first table itself.
    header_row : int or None
        For people.
    skip_rows : tuple of int
        Rows between the first and the last that are none of the table's.
    """

    sheet: str
    first_row: int
    last_row: int
    columns: tuple[MappedColumn, ...]
    number: str | None = None
    rows: Joined | None = None
    header_row: int | None = None
    skip_rows: tuple[int, ...] = ()

    def row_numbers(self) -> tuple[int, ...]:
        """The rows of the modules."""
        skipped = set(self.skip_rows)
        return tuple(row for row in range(self.first_row, self.last_row + 1) if row not in skipped)


@dataclass(frozen=True)
class ColumnMap:
    """Which cells of a workbook hold which quantity, said by a person instead of read from its headings.

    Attributes
    ----------
    tables : tuple of MappedTable
        The first holds x1, y1 and z1. d, R, Ld and Td must be in some table; without l it is the design formula's.

    Examples
    --------
    >>> import mphdrr.core as mph
    >>> columns = mph.ColumnMap.from_toml(open("map.toml").read())    # doctest: +SKIP
    >>> system = mph.read_system("scanner.xlsx", columns=columns)     # doctest: +SKIP
    """

    tables: tuple[MappedTable, ...]

    def faults(self) -> list[str]:
        """What keeps the map from being used, a line each; empty where it is complete."""
        if not self.tables:
            return ["the column map has no [[tables]], expected one with x1, y1, z1 first"]
        faults = [fault for i, table in enumerate(self.tables) for fault in _table_faults(table, i)]
        places: dict[str, str] = {}
        for i, table in enumerate(self.tables):
            for c in table.columns:
                if c.quantity in places:
                    faults.append(f"{_of(i, c.quantity)} is in {places[c.quantity]} too, expected each quantity once")
                places.setdefault(c.quantity, _of(i))
        first = {c.quantity for c in self.tables[0].columns}
        faults += [
            f"{_of(0)} has no column {name}, expected x1, y1, z1 in the first table"
            for name in POSITION
            if name not in first and name not in places
        ]
        faults += [
            f"{places[name]} has {name}, expected x1, y1, z1 in the first table"
            for name in POSITION
            if name not in first and name in places
        ]
        faults += [f"no table has a column {name}" for name in NEEDED[len(POSITION) :] if name not in places]
        faults += self._overlaps()
        return faults

    def _overlaps(self) -> list[str]:
        used: dict[tuple[str, str], list[tuple[set[int], str]]] = {}
        faults = []
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

    def require_complete(self, name: str = "column map") -> None:
        """Raise `InputError` with the first of `faults`, calling the map `name`."""
        for fault in self.faults():
            raise InputError(f"{name}: {fault} ({_HELP})")

    def to_toml(self) -> str:
        """The map as text, which `from_toml` reads."""
        return "\n".join(_table_toml(table) for table in self.tables)

    @classmethod
    def from_toml(cls, text: str, name: str = "column map") -> ColumnMap:
        """The map that `to_toml` wrote, or a person; `name` is how messages call it.

        Raises
        ------
        InputError
            Not TOML, or with keys or values that a map has not. Whether it is complete, `faults` says.
        """
        try:
            values = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{name}: not TOML ({error})") from error
        _refuse_unknown(values, {"tables"}, name)
        tables = values.get("tables")
        if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
            raise InputError(f"{name}: expected [[tables]] ({_HELP})")
        return cls(tuple(_table(table, f"{name}: {_of(i)}") for i, table in enumerate(tables)))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> ColumnMap:
        """The map of a .toml file; `InputError` where it cannot be read."""
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError as error:
            raise InputError(f"{path}: no such file") from error
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from error
        return cls.from_toml(text, str(path))

    def write(self, path: str | os.PathLike[str], comment: str = "") -> None:
        """Write the map to a .toml file, under the lines of a comment."""
        lines = "".join(f"# {line}\n" for line in comment.splitlines())
        with replacing(Path(path)) as temporary:
            temporary.write_text(lines + self.to_toml(), encoding="utf-8")


def column_map(
    columns: ColumnMap | str | os.PathLike[str] | None, workbook: str | os.PathLike[str]
) -> ColumnMap | None:
    """The map of `workbook` that `columns` is, or that its file holds, complete."""
    if columns is None:
        return None
    if isinstance(columns, ColumnMap):
        columns.require_complete(f"{Path(workbook).name}: column map")
        return columns
    found = ColumnMap.read(columns)
    found.require_complete(str(columns))
    return found


def _of(i: int, name: str = "") -> str:
    return f"table {i + 1}" + (f".{name}" if name else "")


def _table_faults(table: MappedTable, i: int) -> list[str]:
    faults = []
    if not 1 <= table.first_row <= table.last_row <= MAX_ROW:
        faults.append(f"{_of(i)}: rows {table.first_row} to {table.last_row}, expected the first row, then the last")
    elif not table.row_numbers():
        faults.append(f"{_of(i)}: skip_rows leaves no row")
    faults += [
        f"{_of(i)}: skip_rows has {row}, expected rows between {table.first_row} and {table.last_row}"
        for row in table.skip_rows
        if not table.first_row < row < table.last_row
    ]
    if not table.columns:
        faults.append(f"{_of(i)} has no columns")
    for c in table.columns:
        quantity = QUANTITIES.get(c.quantity)
        if quantity is None:
            faults.append(f"{_of(i, c.quantity)}: no such quantity, expected {', '.join(QUANTITIES)}")
        elif c.unit not in quantity.units:
            faults.append(f"{_of(i, c.quantity)}: unit {c.unit!r}, expected {', '.join(quantity.units)}")
        if not _is_column(c.column):
            faults.append(f"{_of(i, c.quantity)}: column {c.column!r}, expected letters such as B")
    if table.number is not None and not _is_column(table.number):
        faults.append(f"{_of(i)}: number {table.number!r}, expected a column's letters such as A")
    if i == 0 and table.rows is not None:
        faults.append(f"{_of(0)} has rows = {table.rows!r}, expected it in the tables after the first alone")
    if i > 0 and table.rows not in get_args(Joined):
        faults.append(f"{_of(i)}: rows = {table.rows!r}, expected {' or '.join(map(repr, get_args(Joined)))}")
    if i > 0 and table.rows == "by number" and table.number is None:
        faults.append(f"{_of(i)}: rows = 'by number' without number, expected the column of the numbers")
    if table.rows == "one for all" and len(table.row_numbers()) != 1:
        faults.append(f"{_of(i)}: rows = 'one for all' of several rows, expected first_row = last_row")
    return faults


def _is_column(letters: str) -> bool:
    from openpyxl.utils import column_index_from_string

    return bool(_LETTERS.fullmatch(letters)) and column_index_from_string(letters) <= MAX_COLUMN


def _refuse_unknown(values: Mapping[str, Any], known: set[str], where: str) -> None:
    for key in values:
        if key not in known:
            raise InputError(f"{where}: unknown key {key!r}, expected {', '.join(sorted(known))}")


def _table(values: dict[str, Any], where: str) -> MappedTable:
    known = {"sheet", "header_row", "first_row", "last_row", "skip_rows", "number", "rows", "columns"}
    _refuse_unknown(values, known, where)

    def get(key: str, kind: type, default: Any = ...) -> Any:
        value = values.get(key, default)
        if value is ...:
            raise InputError(f"{where}: has no {key} ({_HELP})")
        if value is not default and type(value) is not kind:
            what = {int: "a whole number", str: "text in quotes", dict: "a table", list: "a list"}[kind]
            raise InputError(f"{where}: {key} = {value!r}, expected {what}")
        return value

    skipped = get("skip_rows", list, [])
    if not all(type(row) is int for row in skipped):
        raise InputError(f"{where}: skip_rows = {skipped!r}, expected whole numbers")
    first = get("first_row", int)
    rows = get("rows", str, None)
    columns = []
    for name, column in get("columns", dict).items():
        if not isinstance(column, dict):
            raise InputError(f'{where}.{name}: expected {{ column = "B", unit = "mm" }}')
        _refuse_unknown(column, {"column", "unit"}, f"{where}.{name}")
        for key in ("column", "unit"):
            if not isinstance(column.get(key), str):
                raise InputError(f'{where}.{name}: has no {key}, expected {{ column = "B", unit = "mm" }}')
        columns.append(MappedColumn(name, column["column"].upper(), column["unit"]))
    number = get("number", str, None)
    return MappedTable(
        sheet=get("sheet", str),
        first_row=first,
        last_row=get("last_row", int, first if rows == "one for all" else ...),
        columns=tuple(columns),
        number=None if number is None else number.upper(),
        rows=rows,
        header_row=get("header_row", int, None),
        skip_rows=tuple(skipped),
    )


def _table_toml(table: MappedTable) -> str:
    lines = ["[[tables]]", f"sheet = {_quoted(table.sheet)}"]
    if table.header_row is not None:
        lines.append(f"header_row = {table.header_row}")
    lines += [f"first_row = {table.first_row}", f"last_row = {table.last_row}"]
    if table.skip_rows:
        lines.append(f"skip_rows = [{', '.join(map(str, table.skip_rows))}]")
    if table.rows is not None:
        lines.append(f"rows = {_quoted(table.rows)}")
    if table.number is not None:
        lines.append(f"number = {_quoted(table.number)}")
    lines.append("[tables.columns]")
    lines += [f"{c.quantity} = {{ column = {_quoted(c.column)}, unit = {_quoted(c.unit)} }}" for c in table.columns]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    marked = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in marked) + '"'
