"""The users' real workbook in every state that occurs: each is read without a map and without a warning."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
from openpyxl.workbook import Workbook
from openpyxl.worksheet.worksheet import Worksheet

from mphdrr.core import PinholeSystem

from .sheets import Book, Formula, Sheet, by_hand, by_xlsxwriter

REAL = Path(__file__).parents[3] / "examples" / "dc-spect-80.xlsx"
BY_LIBREOFFICE = Path(__file__).parent / "files" / "dc-spect-80.xlsx"
COLUMNS = {"d": "P", "R": "Q", "Ld": "S", "Td": "T"}


@functools.cache
def truth() -> PinholeSystem:
    """Return the scanner that the cells hold, by openpyxl."""
    book = openpyxl.load_workbook(REAL, data_only=True)

    def column(sheet: str, letters: str) -> np.ndarray:
        return np.array([row[0].value for row in book[sheet][f"{letters}3:{letters}82"]], dtype=float)

    centers = np.stack([column("Coordinates", letters) for letters in "BCD"], axis=1)
    d, R, Ld, Td = (column("Main", letters) for letters in COLUMNS.values())
    return PinholeSystem(centers, d, column("Coordinates", "G"), Ld, Td, R)


def _saved(edit: Callable[[Workbook], object], data_only: bool = False) -> Callable[[Path], None]:
    """Return a writer by openpyxl after an edit: formulas without values, or values alone."""

    def make(path: Path) -> None:
        book = openpyxl.load_workbook(REAL, data_only=data_only)
        edit(book)
        book.save(path)

    return make


def _as_data() -> Book:
    """Return its cells, with the formulas and their stored values."""
    formulas, values = openpyxl.load_workbook(REAL), openpyxl.load_workbook(REAL, data_only=True)
    sheets = []
    for sheet in formulas.worksheets:
        cells = {}
        for row in sheet.iter_rows():
            for cell in row:
                if isinstance(cell.value, str) and cell.value.startswith("="):
                    cells[cell.coordinate] = Formula(cell.value[1:], values[sheet.title][cell.coordinate].value)
                elif cell.value is not None:
                    cells[cell.coordinate] = cell.value
        sheets.append(Sheet(sheet.title, cells))
    return Book(sheets)


def _extended(book: Workbook) -> None:
    for sheet in book.worksheets:
        for column, heading in (("Y", "serial"), ("Z", "checked by")):
            sheet[f"{column}2"] = heading
            for row in range(3, 83):
                sheet[f"{column}{row}"] = f"{heading} {row}"
    for name in ("MDSL cloud import", "Theta", "Values", "Design Table"):
        added: Worksheet = book.create_sheet(name)
        added.append(["case", "theta", "sum"])
        added.append([1, 0.25, "=SUM(Coordinates!B3:B82)"])


def _with_values(path: Path) -> None:
    pytest.importorskip("xlsxwriter")
    by_xlsxwriter(_as_data(), path)


def _cut(book: Workbook, modules: int) -> None:
    for sheet in book.worksheets:
        sheet.delete_rows(3 + modules, 80)


STATES: dict[str, Callable[[Path], Any]] = {
    "as it is": lambda path: shutil.copy(REAL, path),
    "saved by LibreOffice": lambda path: shutil.copy(BY_LIBREOFFICE, path),
    "saved by openpyxl": _saved(lambda book: None),
    "values alone": _saved(lambda book: None, data_only=True),
    "written by hand": lambda path: by_hand(_as_data(), path),
    "written by XlsxWriter with its values": _with_values,
    "more columns and sheets": _saved(_extended),
    "more columns and sheets, values alone": _saved(_extended, data_only=True),
    "1 modules": _saved(lambda book: _cut(book, 1)),
    "40 modules": _saved(lambda book: _cut(book, 40)),
}
"""Writers of the workbook to a path, by the state that it is then in."""
