"""A column map: what a person says about the cells of a workbook where its headings do not. Kept as TOML."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from ..errors import InputError
from ..files import replacing
from .headings import unit_of
from .quantities import DIMENSIONS, POSITION, QUANTITIES
from .sheet_xml import MAX_COLUMN, MAX_ROW

Joined = Literal["by number", "in order", "one for all"]

_HELP = "see docs/workbook.md"
_KEYS = {"sheet": str, "header_row": int, "first_row": int, "last_row": int, "skip_rows": list} | {
    "rows": str,
    "number": str,
    "columns": dict,
}
_COLUMN = '{ column = "B", unit = "mm" }'


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
        mm, cm, m, in, µm, dm, ft, mil or 0.1 mm; rad or deg. Empty in a draft if it is not known.
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
        Every row from the first to the last holds a module, except `skip_rows`.
    columns : tuple of MappedColumn
    number : str or None
        Letters of the column with the modules' numbers or names. Without it, the first table's modules are 1, 2, ...
    rows : "by number", "in order", "one for all" or None
        How the rows are matched with those of the first table: by the contents of the two `number` columns, in the
        same order, or one row for all modules. None in the first table itself.
    header_row : int or None
        For people.
    skip_rows : tuple of int
        Rows between the first and the last that do not belong to the table.
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

    def with_rows(self, rows: Sequence[int]) -> MappedTable:
        """The table with other rows, which are in ascending order."""
        skipped = sorted(set(range(rows[0], rows[-1])).difference(rows))
        return replace(self, first_row=rows[0], last_row=rows[-1], skip_rows=tuple(skipped))


@dataclass(frozen=True)
class ColumnMap:
    """Which cells of a workbook hold which quantity, given by a person instead of its headings.

    Attributes
    ----------
    tables : tuple of MappedTable
        The first holds x1, y1 and z1. d, R, Ld and Td must be in some table; without l, the design formula is used.

    Examples
    --------
    >>> import mphdrr.core as mph
    >>> columns = mph.ColumnMap.from_toml(open("map.toml").read())    # doctest: +SKIP
    >>> system = mph.read_system("scanner.xlsx", columns=columns)     # doctest: +SKIP
    """

    tables: tuple[MappedTable, ...]

    def faults(self) -> list[str]:
        """Why the map cannot be used, a line for each reason; empty if it is complete."""
        if not self.tables:
            return ["the column map has no [[tables]], expected one with x1, y1, z1 first"]
        faults = [fault for i, table in enumerate(self.tables) for fault in _table_faults(table, i)]
        places: dict[str, str] = {}
        for i, table in enumerate(self.tables):
            for c in table.columns:
                if c.quantity in places:
                    faults.append(f"{_of(i, c.quantity)} is in {places[c.quantity]} too, expected each quantity once")
                places.setdefault(c.quantity, _of(i))
        for name in POSITION:
            if places.get(name) != _of(0):
                found = f"{places[name]} has {name}" if name in places else f"{_of(0)} has no column {name}"
                faults.append(f"{found}, expected x1, y1, z1 in the first table")
        faults += [f"no table has a column {name}" for name in DIMENSIONS if name not in places]
        return faults + list(self._overlaps())

    def _overlaps(self) -> Iterator[str]:
        """The columns that are used twice in the same rows, other than for the modules' numbers."""
        used: dict[tuple[str, str], list[tuple[set[int], str]]] = {}
        for i, table in enumerate(self.tables):
            rows = set(range(max(table.first_row, 1), min(table.last_row, MAX_ROW) + 1))
            names = [(c.quantity, c.column) for c in table.columns]
            names += [("number", table.number)] if table.number else []
            for name, column in names:
                others = used.setdefault((table.sheet.casefold(), column), [])
                for other_rows, other in others:
                    if rows & other_rows and not (name == "number" and other.endswith(".number")):
                        yield f"{_of(i, name)}: column {column} is {other} too, expected another column"
                others.append((rows, _of(i, name)))

    def to_toml(self) -> str:
        """The map as text, which `from_toml` reads."""
        return "\n".join(_table_toml(table) for table in self.tables)

    @classmethod
    def from_toml(cls, text: str, name: str = "column map") -> ColumnMap:
        """The map in a text that `to_toml` or a person wrote; messages call it `name`.

        Raises
        ------
        InputError
            The text is not TOML, or has unknown keys or values. Whether the map is complete is told by `faults`.
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
        """The map in a .toml file; `InputError` if it cannot be read."""
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError as error:
            raise InputError(f"{path}: no such file") from error
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from error
        return cls.from_toml(text, str(path))

    def write(self, path: str | os.PathLike[str], comment: str = "") -> None:
        """Write the map to a .toml file, below the lines of a comment."""
        lines = "".join(f"# {line}\n" for line in comment.splitlines())
        with replacing(Path(path)) as temporary:
            temporary.write_text(lines + self.to_toml(), encoding="utf-8")


def column_map(
    columns: ColumnMap | str | os.PathLike[str] | None, workbook: str | os.PathLike[str]
) -> ColumnMap | None:
    """The column map of `workbook`, given as such or as the path of its file; `InputError` if it is not complete."""
    if columns is None:
        return None
    name = str(columns)
    if isinstance(columns, ColumnMap):
        name = f"{Path(workbook).name}: column map"
    else:
        columns = ColumnMap.read(columns)
    for fault in columns.faults():
        raise InputError(f"{name}: {fault} ({_HELP})")
    return columns


def _of(i: int, name: str = "") -> str:
    return f"table {i + 1}" + (f".{name}" if name else "")


def _table_faults(table: MappedTable, i: int) -> Iterator[str]:
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
        quantity = QUANTITIES.get(c.quantity)
        if quantity is None:
            yield f"{_of(i, c.quantity)}: no such quantity, expected {', '.join(QUANTITIES)}"
        elif c.unit not in quantity.units:
            yield f"{_of(i, c.quantity)}: unit {c.unit!r}, expected {', '.join(quantity.units)}"
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


def _refuse_unknown(values: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    for key in values:
        if key not in known:
            raise InputError(f"{where}: unknown key {key!r}, expected {', '.join(sorted(known))}")


def _table(values: dict[str, Any], where: str) -> MappedTable:
    _refuse_unknown(values, _KEYS, where)
    if values.get("rows") == "one for all" and "first_row" in values:
        values = {"last_row": values["first_row"], **values}
    for key in ("sheet", "first_row", "last_row", "columns"):
        if key not in values:
            raise InputError(f"{where}: has no {key} ({_HELP})")
    for key, value in values.items():
        if type(value) is not _KEYS[key]:
            what = {int: "a whole number", str: "text in quotes", dict: "a table", list: "a list"}[_KEYS[key]]
            raise InputError(f"{where}: {key} = {value!r}, expected {what}")
    skipped = values.get("skip_rows", [])
    if not all(type(row) is int for row in skipped):
        raise InputError(f"{where}: skip_rows = {skipped!r}, expected whole numbers")
    columns = tuple(_column(name, column, f"{where}.{name}") for name, column in values["columns"].items())
    number = values["number"].upper() if "number" in values else None
    return MappedTable(**{**values, "columns": columns, "number": number, "skip_rows": tuple(skipped)})


def _column(name: str, values: Any, where: str) -> MappedColumn:
    if not isinstance(values, dict):
        raise InputError(f"{where}: expected {_COLUMN}")
    _refuse_unknown(values, ("column", "unit"), where)
    for key in ("column", "unit"):
        if not isinstance(values.get(key), str):
            raise InputError(f"{where}: has no {key}, expected {_COLUMN}")
    return MappedColumn(name, values["column"].upper(), values["unit"])


def _table_toml(table: MappedTable) -> str:
    lines = ["[[tables]]"]
    for key in _KEYS:
        value = getattr(table, key)
        if key != "columns" and value not in (None, ()):
            lines.append(f"{key} = {_toml(value)}")
    lines.append("[tables.columns]")
    lines += [f"{c.quantity} = {{ column = {_toml(c.column)}, unit = {_toml(c.unit)} }}" for c in table.columns]
    return "\n".join(lines) + "\n"


def _toml(value: int | str | tuple[int, ...]) -> str:
    """A value as TOML, which writes it as JSON does."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
