"""Workbook file and the values of its cells. The file is read once, into memory, and never opened for writing."""

import hashlib
import io
import zipfile
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from ..files import AnyPath, read_bytes, require_file
from .calculation import Calculation, UncomputedValue
from .sheet_xml import Cell, CellError, Position, Reference, UnreadableValue
from .workbook_xml import Address, WorkbookXml

MAX_FILE_BYTES = 256 * 2**20
MAX_UNPACKED_BYTES = 2**30
MAX_ROWS = 100_000
"""Largest number of rows with content in a sheet that is read."""
HEADING_ROWS = 20
"""Number of a sheet's first rows that may hold headings."""
_SAME_RESULT = 1e-6
"""Largest difference, relative and absolute, between the stored and the computed value of a formula that agree."""

SAVING = "opening the workbook in Excel or LibreOffice and saving it"

_OLE = bytes.fromhex("d0cf11e0a1b11ae1")
_XLS_STREAMS = tuple(name.encode("utf-16-le") for name in ("Workbook", "Book"))


class OutdatedValue(NamedTuple):
    """Stand-in for a formula's value: the file's stored one differs from the one computed from the cells."""

    stored: Any
    computed: Any


class Book:
    """Workbook read from an .xlsx or .xlsm file.

    Raises `InputError` for a file that is missing, unreadable, too large or no workbook.
    """

    def __init__(self, path: AnyPath) -> None:
        self.path = Path(path)
        content = _read_workbook_bytes(self.path)
        self.sha256 = hashlib.sha256(content).hexdigest()
        self.workbook = WorkbookXml(content, self.path.name)
        self.sheets = {title: Sheet(self, title) for title in self.workbook.parts}
        self.unverified: dict[Address, str] = {}
        """Address of each formula whose stored value was used unchecked, in a file that asks to be calculated -> why."""
        self.calculation = Calculation(
            self.workbook, self._cell, lambda _, cell: cell.formula is not None, self._stored_or_computed
        )

    def sheet(self, name: str, purpose: str) -> "Sheet":
        """Return a sheet by its name; raise `InputError` if it is missing, with the `purpose` behind the name."""
        if name not in self.sheets:
            names = ", ".join(self.sheets) or "none"
            raise InputError(f"{self.path.name}: has no sheet {name}{purpose}; its sheets are {names}")
        return self.sheets[name]

    def _stored_or_computed(self, address: Address, computed: Any) -> Any:
        """Return the computed value of a formula, or if there is none, its stored value where that can be relied on."""
        stored, asks_for_calculation = self._cell(address).value, self.workbook.asks_for_calculation
        if not isinstance(computed, UncomputedValue) or stored is None:
            return computed
        if stored in (0, "") and (asks_for_calculation or self.workbook.was_never_calculated):
            return UncomputedValue(f"it stores {stored!r}, as programs do that calculate nothing, and {computed}")
        if asks_for_calculation:
            self.unverified[address] = str(computed)
        return stored

    def _cell(self, address: Address) -> Cell:
        """Return the content of a cell as it is in the file."""
        return self.sheets[address[0]].cells.get(address[1:], Cell())


class Sheet:
    """Cells of one sheet of a book, as they are in the file."""

    def __init__(self, book: Book, name: str) -> None:
        self.book, self.name = book, name

    @cached_property
    def cells(self) -> dict[Position, Cell]:
        """(row, column), both counted from 1 -> cell."""
        return self.book.workbook.sheet(self.name).original

    @cached_property
    def rows(self) -> list[int]:
        """Rows with content, ascending; `InputError` if they are too many for a table of modules."""
        filled_rows = sorted({row for (row, _), cell in self.cells.items() if not cell.blank})
        if len(filled_rows) > MAX_ROWS:
            problem = f"sheet {self.name} has more than {MAX_ROWS} rows with content"
            raise InputError(f"{self.book.path.name}: {problem}: expected one row per module")
        return filled_rows

    @cached_property
    def texts(self) -> dict[Position, str]:
        """Texts that cells show, sorted by position; below the rows of headings, a formula's text only as stored."""
        values = {p: cell.value if p[0] > HEADING_ROWS else self.value(*p) for p, cell in self.cells.items()}
        return {position: text for position, text in sorted(values.items()) if type(text) is str and text.strip()}

    @property
    def merged_areas(self) -> list[Reference]:
        """Areas of cells that are shown as one cell."""
        return self.book.workbook.sheet(self.name).merged_areas

    def value(self, row: int, column: int) -> Any:
        """Return the value of a cell, None if blank.

        A formula without a reliable value gives an `UncomputedValue` or an `OutdatedValue`.
        """
        if (cell := self.cells.get((row, column))) is None:
            return None
        value = cell.value
        if cell.formula is not None:
            computed = self.book.calculation.value((self.name, row, column))
            if value is None or isinstance(computed, UncomputedValue):
                value = computed
            elif not _is_same_result(value, computed):
                is_placeholder = value in (0, "") and self.book.workbook.was_never_calculated
                value = computed if is_placeholder else OutdatedValue(value, computed)
        return None if type(value) is str and not value.strip() else value

    def formula(self, row: int, column: int) -> str | None:
        """Return the formula in a cell, with its "=", None if the cell has none."""
        return self.cells.get((row, column), Cell()).formula

    def is_date(self, row: int, column: int) -> bool:
        """Return whether a cell shows its number as a date or a time."""
        from openpyxl.styles.numbers import is_date_format

        return is_date_format(self.number_format(row, column))

    def number_format(self, row: int, column: int) -> str:
        """Return the number format of a cell, such as ``0.00" mm"``; "" for a cell that does not exist."""
        cell = self.cells.get((row, column))
        return "" if cell is None else self.book.workbook.number_format(cell)

    def address(self, row: int, column: int) -> str:
        """Return the address of a cell, such as ``Coordinates!B3``."""
        return self.book.workbook.address_text((self.name, row, column))

    def location(self, row: int, column: int) -> str:
        """Return file name and address of a cell, with which every message about the cell begins."""
        return f"{self.book.path.name}: {self.address(row, column)}"

    def describe_content(self, row: int, column: int) -> str:
        """Return the content of a cell as the predicate of a message, such as "is blank"."""
        value, formula = self.value(row, column), shorten(self.formula(row, column) or "")
        if value is None:
            return "is blank"
        if isinstance(value, UncomputedValue):
            remedy = f"{SAVING} stores the value"
            return f"holds the formula {formula} without a stored value ({shorten(value, 80)}; {remedy})"
        if isinstance(value, OutdatedValue):
            gives = f"its formula {formula} gives {_value_text(value.computed)}"
            return f"stores {_value_text(value.stored)}, but {gives} ({SAVING} stores the right value)"
        if isinstance(value, CellError):
            return f"shows the error {value}"
        if isinstance(value, bool):
            return f"is {str(value).upper()}"
        if isinstance(value, float):
            is_date = self.is_date(row, column)
            return f"is formatted as a date or time ({self.number_format(row, column)})" if is_date else f"is {value:g}"
        is_text = not isinstance(value, UnreadableValue)
        return f"holds the text {shorten(value)!r}" if is_text else f"holds {shorten(value)!r}, which is not a number"


def parse_module_number(value: Any) -> int | None:
    """Return the whole number in a cell, stored as a number or as text; None for any other value."""
    if type(value) is str:
        text = value.strip()
        return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 2**53 else None


def shorten(text: str, max_length: int = 40) -> str:
    """Return a text on one line, cut off with "…" where it exceeds `max_length` characters."""
    text = " ".join(text.split())
    return text if len(text) <= max_length else text[: max_length - 1] + "…"


def _value_text(value: Any) -> str:
    """Return a cell's value as messages show it."""
    return f"{value:.9g}" if type(value) is float else repr(value)


def _is_same_result(stored: Any, computed: Any) -> bool:
    """Return whether the stored value of a formula agrees with the computed one."""
    if type(stored) is float and type(computed) is float:
        return abs(stored - computed) <= _SAME_RESULT * max(1.0, abs(computed))
    return type(stored) is type(computed) and stored == computed


def _read_workbook_bytes(path: Path) -> bytes:
    """Return the bytes of a file that looks like an .xlsx workbook; raise `InputError` for any other file."""
    if (size := require_file(path, "an .xlsx workbook").stat().st_size) > MAX_FILE_BYTES:
        raise InputError(f"{path}: {size} bytes, expected a workbook of at most {MAX_FILE_BYTES} bytes")
    content = read_bytes(path)
    if (problem := _describe_other_format(path.name, content)) is not None:
        raise InputError(f"{path}: {problem}")
    return content


def _describe_other_format(name: str, content: bytes) -> str | None:
    """Return for a message what a file is instead of an .xlsx workbook, None if it may be a workbook."""
    if name.startswith("~$"):
        return f"this is Excel's lock file, expected the workbook {name[2:]}"
    if content.startswith(_OLE) and not any(name in content for name in _XLS_STREAMS):
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
