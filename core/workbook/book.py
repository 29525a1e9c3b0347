"""A workbook file and its cells' values. The file is read once, into memory, and never opened for writing."""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from .formulas import NotComputable
from .sheet_xml import At, Cell, Unreadable
from .workbook_xml import Place, WorkbookXml

MAX_FILE_BYTES = 256 * 2**20
MAX_UNPACKED_BYTES = 2**30
MAX_ROWS = 100_000
"""Rows with something in them, in a sheet that is read."""
SAME_RESULT = 1e-6
"""Relative, and absolute: a formula's stored value differs less from what its inputs give."""

HEADING_ROWS = 20
"""Headings stand in a sheet's first rows."""

_OLE = bytes.fromhex("d0cf11e0a1b11ae1")
_ENCRYPTED = "EncryptedPackage".encode("utf-16-le")


class Uncomputed(str):
    """Stands for a formula that has no value to rely on and cannot be computed here; the text says why."""


class Outdated(NamedTuple):
    """Stands for a formula whose stored value is not what its inputs give."""

    stored: Any
    computed: Any


class Book:
    """An .xlsx or .xlsm file.

    Attributes
    ----------
    path : Path
    sha256 : str
        Of the file's bytes, hexadecimal.
    workbook : WorkbookXml
    sheets : dict
        Name -> `Sheet`, in the workbook's order.
    unverified : dict
        Formula that cannot be computed here and whose stored value was taken although the file asks for calculation
        -> why it cannot.

    Raises
    ------
    InputError
        The file is missing, unreadable, too large or not a workbook.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        content = _read(self.path)
        self.sha256 = hashlib.sha256(content).hexdigest()
        _refuse_other_formats(self.path, content)
        self.workbook = WorkbookXml(content, self.path.name)
        self.sheets = {title: Sheet(self, title) for title in self.workbook.sheets}
        self.unverified: dict[Place, str] = {}
        self._computed: dict[Place, Any] = {}

    def sheet(self, name: str) -> Sheet | None:
        """The sheet called `name` in whatever case, as in a formula."""
        title = self.workbook.title(name)
        return None if title is None else self.sheets[title]

    def original(self, place: Place) -> Cell | None:
        """A cell as it was read."""
        return self.workbook.sheets[place[0]].original.get(place[1:])

    def computed(self, place: Place) -> Any:
        """What a formula's inputs give, all the way from what is typed; `Uncomputed` where that is beyond us."""
        waiting, begun = [place], set()
        while waiting:
            current = waiting[-1]
            if current in self._computed:
                waiting.pop()
                continue
            needed: list[Place] = []
            result = self._result(current, needed)
            loop = next((other for other in needed if other == current or other in begun), None)
            if loop is not None:
                result = Uncomputed(f"it refers to {self.workbook.text(loop)}, which refers back to it")
            elif needed:
                begun.add(current)
                waiting += needed
                continue
            self._computed[current] = result
        return self._computed[place]

    def _result(self, place: Place, needed: list[Place]) -> Any:
        """What a formula gives, or nothing to rely on and, in `needed`, the formulas that must be computed before."""

        def value_of(other: Place) -> Any:
            cell = self.original(other)
            if cell is None:
                return None
            if isinstance(cell.value, Unreadable):
                raise NotComputable(f"{self.workbook.text(other)} holds {cell.value!r}")
            if cell.formula is None:
                return cell.value
            if other not in self._computed:
                needed.append(other)
                return 0.0
            value = self.relied_on(other)
            if isinstance(value, Uncomputed):
                raise NotComputable(f"it needs {self.workbook.text(other)}, and there: {value}")
            return value

        cell = self.original(place)
        assert cell is not None and cell.formula is not None, "only formulas are computed"
        if cell.array is not None:
            return Uncomputed("it is an array formula or a data table")
        try:
            return self.workbook.calculated(place, cell.formula, value_of)
        except NotComputable as why:
            return Uncomputed(str(why))

    def relied_on(self, place: Place) -> Any:
        """What a formula gives: as computed here, else as stored, else `Uncomputed`."""
        computed = self.computed(place)
        cell = self.original(place)
        if not isinstance(computed, Uncomputed) or cell is None or cell.value is None:
            return computed
        if self.workbook.asks_for_calculation:
            # Programs that cannot calculate, as XlsxWriter, store a 0 for every formula.
            if cell.value == 0 or cell.value == "":
                return Uncomputed(f"it stores {cell.value!r} and the file asks to be calculated, but {computed}")
            self.unverified[place] = str(computed)
        return cell.value


class Sheet:
    """The cells of one sheet, as they are in the file."""

    def __init__(self, book: Book, name: str) -> None:
        self.book = book
        self.name = name

    @property
    def cells(self) -> dict[At, Cell]:
        """(row, column) -> cell, both counted from 1."""
        return self.book.workbook.sheets[self.name].original

    @cached_property
    def rows(self) -> list[int]:
        """The rows with content; `InputError` where they are too many for a table of modules."""
        found = sorted({at[0] for at, cell in self.cells.items() if not cell.blank})
        if len(found) > MAX_ROWS:
            raise InputError(
                f"{self.book.path.name}: sheet {self.name} has more than {MAX_ROWS} rows with content: "
                "expected a row a module"
            )
        return found

    @cached_property
    def texts(self) -> dict[At, str]:
        """The cells that show text, typed or a formula's; below the first rows, those of formulas only if stored."""
        shown = {at: cell.value if at[0] > HEADING_ROWS else self.value(*at) for at, cell in self.cells.items()}
        return {at: text for at, text in shown.items() if type(text) is str and text.strip()}

    @property
    def comments(self) -> dict[At, str]:
        """The cells' comments."""
        return self.book.workbook.comments(self.name)

    def formula(self, row: int, column: int) -> str | None:
        """The formula in a cell."""
        cell = self.cells.get((row, column))
        return cell.formula if cell is not None else None

    def value(self, row: int, column: int) -> Any:
        """What a cell holds, None if blank; of a formula that says nothing to rely on, `Uncomputed` or `Outdated`."""
        cell = self.cells.get((row, column))
        if cell is None:
            return None
        value = cell.value
        if cell.formula is not None:
            place = (self.name, row, column)
            relied = self.book.relied_on(place)
            if value is None or isinstance(relied, Uncomputed) or not _same_result(value, relied):
                value = relied if value is None or isinstance(relied, Uncomputed) else Outdated(value, relied)
        return None if type(value) is str and not value.strip() else value

    def is_date(self, row: int, column: int) -> bool:
        """Whether a cell shows its number as a date or a time."""
        from openpyxl.styles.numbers import is_date_format

        cell = self.cells.get((row, column))
        return cell is not None and is_date_format(self.number_format(row, column))

    def number_format(self, row: int, column: int) -> str:
        """How a cell shows its number, such as ``0.00" mm"``."""
        return self.book.workbook.number_format(self.cells[row, column])

    def place(self, row: int, column: int) -> str:
        """A cell's name, e.g. ``Coordinates!B3``."""
        return self.book.workbook.text((self.name, row, column))


def _same_result(stored: Any, computed: Any) -> bool:
    if type(stored) is float and type(computed) is float:
        return abs(stored - computed) <= SAME_RESULT * max(1.0, abs(computed))
    return type(stored) is type(computed) and stored == computed


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
