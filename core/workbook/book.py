"""A workbook file and its cells' values. The file is read once, into memory, and never opened for writing."""

from __future__ import annotations

import hashlib
import io
import math
import os
import warnings
import zipfile
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import InputError
from .formulas import CellError, NotComputable, evaluate

MAX_FILE_BYTES = 256 * 2**20
MAX_UNPACKED_BYTES = 2**30
MAX_ROWS = 100_000
"""Rows with something in them, in a sheet that is read."""

_OLE = bytes.fromhex("d0cf11e0a1b11ae1")
_ENCRYPTED = "EncryptedPackage".encode("utf-16-le")


class Uncomputed(str):
    """Stands for a formula that has no stored value and cannot be computed here; the text says why."""


class Book:
    """An .xlsx or .xlsm file; `content` is its bytes.

    Raises
    ------
    InputError
        The file is missing, unreadable, too large or not a workbook.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.content = _read(self.path)
        self.sha256 = hashlib.sha256(self.content).hexdigest()
        _refuse_other_formats(self.path, self.content)
        self._values = self._load(data_only=True)
        self.sheets = {ws.title: Sheet(self, ws.title) for ws in self._values.worksheets}
        self._by_folded_name = {name.casefold(): sheet for name, sheet in self.sheets.items()}

    def sheet(self, name: str) -> Sheet | None:
        """The sheet called `name` in whatever case, as in a formula."""
        return self._by_folded_name.get(name.casefold())

    @cached_property
    def _formulas(self) -> Any:
        # A second load, only for files in which a wanted cell has no stored value.
        return self._load(data_only=False)

    def _load(self, data_only: bool) -> Any:
        import openpyxl

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # openpyxl's, about styles and extensions that are of no concern here
            try:
                return openpyxl.load_workbook(
                    io.BytesIO(self.content), read_only=True, data_only=data_only, keep_links=False
                )
            except Exception as error:  # whatever openpyxl meets in a damaged file
                raise InputError(
                    f"{self.path}: not an .xlsx workbook, or a damaged one ({_one_line(error)})"
                ) from error

    def rows(self, sheet: str, data_only: bool = True, last: int | None = None) -> Iterator[tuple[int, list[Any]]]:
        """(row number, its non-empty openpyxl cells) of each row that has any, up to row `last`."""
        worksheet = (self._values if data_only else self._formulas)[sheet]
        worksheet.reset_dimensions()  # the size stated in the file may be wrong, or a million empty rows
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                for row in worksheet.iter_rows(max_row=last):
                    # "str" without a value is a formula whose stored value is the empty text.
                    cells = [cell for cell in row if cell.value is not None or cell.data_type == "str"]
                    if cells:
                        yield cells[0].row, cells
            except Exception as error:
                raise InputError(f"{self.path.name}: sheet {sheet} cannot be read ({_one_line(error)})") from error


class Sheet:
    """The cells of one sheet, read when first asked for."""

    def __init__(self, book: Book, name: str) -> None:
        self.book = book
        self.name = name
        self._computed: dict[tuple[int, int], Any] = {}
        self._computing: set[tuple[int, int]] = set()

    def top(self, last: int) -> dict[tuple[int, int], Any]:
        """{(row, column): value} of the first `last` rows, both counted from 1."""
        rows = self.book.rows(self.name, last=last)
        return {(row, cell.column): _value(cell) for row, cells in rows for cell in cells}

    @cached_property
    def stored(self) -> dict[tuple[int, int], Any]:
        """{(row, column): value} of the cells that have a stored value."""
        return self._read(data_only=True)

    @cached_property
    def formulas(self) -> dict[tuple[int, int], str]:
        """{(row, column): formula} of the cells that hold one."""
        cells = self._read(data_only=False)
        return {at: value for at, value in cells.items() if isinstance(value, str) and value.startswith("=")}

    def _read(self, data_only: bool) -> dict[tuple[int, int], Any]:
        found: dict[tuple[int, int], Any] = {}
        for n, (row, cells) in enumerate(self.book.rows(self.name, data_only)):
            if n >= MAX_ROWS:
                raise InputError(
                    f"{self.book.path.name}: sheet {self.name} has more than {MAX_ROWS} rows with content: "
                    "expected a row a module"
                )
            found.update({(row, cell.column): _value(cell) for cell in cells})
        return found

    @cached_property
    def rows(self) -> list[int]:
        """The rows with content."""
        return sorted({row for row, _ in (*self.stored, *self.formulas)})

    def value(self, row: int, column: int) -> Any:
        """What a cell shows: None if blank, else a float, str, bool, date, `CellError` or `Uncomputed`."""
        at = (row, column)
        if at in self.stored:
            return self.stored[at]
        if at not in self.formulas:
            return None
        if at not in self._computed:
            self._computed[at] = self._compute(at)
        return self._computed[at]

    def _compute(self, at: tuple[int, int]) -> Any:
        if at in self._computing:
            raise NotComputable(f"{self.place(*at)} refers to itself")
        self._computing.add(at)
        try:
            return evaluate(self.formulas[at], self._referred)
        except NotComputable as why:
            return Uncomputed(str(why))
        except RecursionError:
            return Uncomputed("its chain of references is too long")
        except (ArithmeticError, ValueError) as error:
            return CellError("#DIV/0!" if isinstance(error, ZeroDivisionError) else "#NUM!")
        finally:
            self._computing.discard(at)

    def _referred(self, sheet_name: str | None, row: int, column: int) -> Any:
        sheet = self if sheet_name is None else self.book.sheet(sheet_name)
        if sheet is None:
            raise NotComputable(f"there is no sheet {sheet_name}")
        value = sheet.value(row, column)
        if isinstance(value, Uncomputed):
            raise NotComputable(value)
        return value

    def place(self, row: int, column: int) -> str:
        """A cell's name, e.g. ``Coordinates!B3``."""
        from openpyxl.utils import get_column_letter

        return f"{self.name}!{get_column_letter(column)}{row}"


def _read(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder, expected an .xlsx workbook")
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise InputError(f"{path}: {size} bytes, expected a workbook of at most {MAX_FILE_BYTES} bytes")
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{str(path)!r}: not a file name ({error})") from error


def _refuse_other_formats(path: Path, content: bytes) -> None:
    if path.name.startswith("~$"):
        raise InputError(f"{path}: this is Excel's lock file, expected the workbook {path.name[2:]}")
    if content.startswith(_OLE):
        if _ENCRYPTED in content:
            raise InputError(f"{path}: the workbook is protected by a password, expected one saved without it")
        raise InputError(f"{path}: an old Excel .xls file (or another OLE document), expected it saved as .xlsx")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info.filename: info.file_size for info in archive.infolist()}
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        found = "an empty file" if not content else "not a zip archive, or a truncated one"
        raise InputError(f"{path}: not an .xlsx workbook ({found})") from error
    if sum(members.values()) > MAX_UNPACKED_BYTES:
        raise InputError(f"{path}: unpacks to {sum(members.values())} bytes, expected at most {MAX_UNPACKED_BYTES}")
    if "xl/workbook.bin" in members:
        raise InputError(f"{path}: a binary .xlsb workbook, expected it saved as .xlsx")
    if "mimetype" in members and "content.xml" in members:
        raise InputError(f"{path}: an OpenDocument file, expected it saved as .xlsx")


def _value(cell: Any) -> Any:
    value = cell.value
    if cell.data_type == "e":
        return CellError(value)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    if isinstance(value, str):
        return value if value.strip() else None
    # openpyxl wraps array formulas; their text is what counts here.
    return getattr(value, "text", value)


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:160]
