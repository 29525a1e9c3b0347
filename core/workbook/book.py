"""A workbook file and the values of its cells. The file is read once, into memory, and never opened for writing."""

import hashlib
import io
import zipfile
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from ..files import AnyPath, read_bytes, require_file
from .calculation import Calculation, Uncomputed
from .sheet_xml import At, Cell, CellError, Reference, Unreadable
from .workbook_xml import Place, WorkbookXml

MAX_FILE_BYTES = 256 * 2**20
MAX_UNPACKED_BYTES = 2**30
MAX_ROWS = 100_000
"""Rows with content in a sheet that is read."""
HEADING_ROWS = 20
"""Headings stand in a sheet's first rows."""
_SAME_RESULT = 1e-6
"""Largest difference, relative and absolute, between a formula's stored value and what it gives."""

SAVING = "opening the workbook in Excel or LibreOffice and saving it"

_OLE = bytes.fromhex("d0cf11e0a1b11ae1")
_ENCRYPTED = "EncryptedPackage".encode("utf-16-le")


class Outdated(NamedTuple):
    """Stands for a formula whose stored value is not what it gives."""

    stored: Any
    computed: Any


class Book:
    """An .xlsx or .xlsm file; `InputError` if it is missing, unreadable, too large or not a workbook."""

    def __init__(self, path: AnyPath) -> None:
        self.path = Path(path)
        content = _read(self.path)
        self.sha256 = hashlib.sha256(content).hexdigest()
        self.workbook = WorkbookXml(content, self.path.name)
        self.sheets = {title: Sheet(self, title) for title in self.workbook.parts}
        self.unverified: dict[Place, str] = {}
        """Formulas whose stored value was used although the file asks to be calculated -> why they cannot be."""
        self.calculation = Calculation(
            self.workbook, self._cell, lambda _, cell: cell.formula is not None, self._relied_on
        )

    def sheet(self, name: str, why: str) -> "Sheet":
        """A sheet, or `InputError`, which tells `why` it is wanted."""
        if name not in self.sheets:
            names = ", ".join(self.sheets) or "none"
            raise InputError(f"{self.path.name}: has no sheet {name}{why}; its sheets are {names}")
        return self.sheets[name]

    def _relied_on(self, place: Place, computed: Any) -> Any:
        stored = self._cell(place).value
        if not isinstance(computed, Uncomputed) or stored is None:
            return computed
        if stored in (0, "") and (self.workbook.asks_for_calculation or self.workbook.never_calculated):
            return Uncomputed(f"it stores {stored!r}, as programs do that calculate nothing, and {computed}")
        if self.workbook.asks_for_calculation:
            self.unverified[place] = str(computed)
        return stored

    def _cell(self, place: Place) -> Cell:
        return self.sheets[place[0]].cells.get(place[1:], Cell())


class Sheet:
    """The cells of one sheet, as they are in the file."""

    def __init__(self, book: Book, name: str) -> None:
        self.book, self.name = book, name

    @cached_property
    def cells(self) -> dict[At, Cell]:
        """(row, column) -> cell, both counted from 1."""
        return self.book.workbook.sheet(self.name).original

    @cached_property
    def rows(self) -> list[int]:
        """The rows with content; `InputError` if they are too many for a table of modules."""
        found = sorted({at[0] for at, cell in self.cells.items() if not cell.blank})
        if len(found) > MAX_ROWS:
            many = f"sheet {self.name} has more than {MAX_ROWS} rows with content"
            raise InputError(f"{self.book.path.name}: {many}: expected a row a module")
        return found

    @cached_property
    def texts(self) -> dict[At, str]:
        """The cells that show text, sorted; below the rows of headings, the text of a formula only as stored."""
        shown = {at: cell.value if at[0] > HEADING_ROWS else self.value(*at) for at, cell in self.cells.items()}
        return {at: text for at, text in sorted(shown.items()) if type(text) is str and text.strip()}

    @property
    def merged(self) -> list[Reference]:
        """Cells that are shown as one."""
        return self.book.workbook.sheet(self.name).merged

    def value(self, row: int, column: int) -> Any:
        """What a cell holds, None if blank; `Uncomputed` or `Outdated` for a formula without a reliable value."""
        cell = self.cells.get((row, column))
        if cell is None:
            return None
        value = cell.value
        if cell.formula is not None:
            given = self.book.calculation.value((self.name, row, column))
            if value is None or isinstance(given, Uncomputed):
                value = given
            elif not _same_result(value, given):
                value = given if value in (0, "") and self.book.workbook.never_calculated else Outdated(value, given)
        return None if type(value) is str and not value.strip() else value

    def formula(self, row: int, column: int) -> str | None:
        """The formula in a cell."""
        return self.cells.get((row, column), Cell()).formula

    def is_date(self, row: int, column: int) -> bool:
        """Whether a cell shows its number as a date or a time."""
        from openpyxl.styles.numbers import is_date_format

        return is_date_format(self.number_format(row, column))

    def number_format(self, row: int, column: int) -> str:
        """How a cell shows its number, such as ``0.00" mm"``; "" for a cell that does not exist."""
        cell = self.cells.get((row, column))
        return "" if cell is None else self.book.workbook.number_format(cell)

    def place(self, row: int, column: int) -> str:
        """A cell's name, e.g. ``Coordinates!B3``."""
        return self.book.workbook.text((self.name, row, column))

    def where(self, row: int, column: int) -> str:
        """File and cell: how every message about a cell begins."""
        return f"{self.book.path.name}: {self.place(row, column)}"

    def found(self, row: int, column: int) -> str:
        """What is in a cell, as the predicate of a message: "is blank"."""
        value, formula = self.value(row, column), shortened(self.formula(row, column) or "")
        if value is None:
            return "is blank"
        if isinstance(value, Uncomputed):
            remedy = f"{SAVING} stores the value"
            return f"holds the formula {formula} without a stored value ({shortened(value, 80)}; {remedy})"
        if isinstance(value, Outdated):
            gives = f"its formula {formula} gives {_number(value.computed)}"
            return f"stores {_number(value.stored)}, but {gives} ({SAVING} stores the right value)"
        if isinstance(value, CellError):
            return f"shows the error {value}"
        if isinstance(value, bool):
            return f"is {str(value).upper()}"
        if isinstance(value, float):
            is_date = self.is_date(row, column)
            return f"is formatted as a date or time ({self.number_format(row, column)})" if is_date else f"is {value:g}"
        holds = f"{shortened(value)!r}"
        return f"holds {holds}, which is not a number" if isinstance(value, Unreadable) else f"holds the text {holds}"


def module_number(value: Any) -> int | None:
    """The whole number in a cell, stored as a number or as text; None for anything else."""
    if type(value) is str:
        text = value.strip()
        return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 2**53 else None


def shortened(text: str, longest: int = 40) -> str:
    """A text on one line, cut off if it is long."""
    text = " ".join(text.split())
    return text if len(text) <= longest else text[: longest - 1] + "…"


def _number(value: Any) -> str:
    return f"{value:.9g}" if type(value) is float else repr(value)


def _same_result(stored: Any, computed: Any) -> bool:
    if type(stored) is float and type(computed) is float:
        return abs(stored - computed) <= _SAME_RESULT * max(1.0, abs(computed))
    return type(stored) is type(computed) and stored == computed


def _read(path: Path) -> bytes:
    """The bytes of a file that has the looks of an .xlsx workbook; `InputError` for any other."""
    size = require_file(path, "an .xlsx workbook").stat().st_size
    if size > MAX_FILE_BYTES:
        raise InputError(f"{path}: {size} bytes, expected a workbook of at most {MAX_FILE_BYTES} bytes")
    content = read_bytes(path)
    if (other := _other_format(path.name, content)) is not None:
        raise InputError(f"{path}: {other}")
    return content


def _other_format(name: str, content: bytes) -> str | None:
    """What a file is instead of an .xlsx workbook."""
    if name.startswith("~$"):
        return f"this is Excel's lock file, expected the workbook {name[2:]}"
    if content.startswith(_OLE) and _ENCRYPTED in content:
        return "the workbook is protected by a password, expected one saved without it"
    if content.startswith(_OLE):
        return "an old Excel .xls file (or another OLE document), expected it saved as .xlsx"
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info.filename: info.file_size for info in archive.infolist()}
    except (zipfile.BadZipFile, NotImplementedError, ValueError):
        return f"not an .xlsx workbook ({'not a zip archive, or a truncated one' if content else 'an empty file'})"
    if sum(members.values()) > MAX_UNPACKED_BYTES:
        return f"unpacks to {sum(members.values())} bytes, expected at most {MAX_UNPACKED_BYTES}"
    if "xl/workbook.bin" in members:
        return "a binary .xlsb workbook, expected it saved as .xlsx"
    return "an OpenDocument file, expected it saved as .xlsx" if {"mimetype", "content.xml"} <= members.keys() else None
