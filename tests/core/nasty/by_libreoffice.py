"""Workbooks that LibreOffice has saved, kept in files/ since not every machine has it.

``python -m tests.core.nasty.by_libreoffice`` in the repository's root makes them again, with soffice on the path.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from .case import REFUSED, RIGHT, WARNED_OF, Catalogue
from .scanners import (
    BIG,
    ONE_SHEET_COLUMNS,
    SCANNER,
    SYMBOLS,
    one_sheet,
    one_sheet_map,
    scanner,
    typed,
    users,
    users_map,
)
from .sheets import Book, Formula, by_hand

CASES = Catalogue("LibreOffice")
REAL = Path(__file__).parents[3] / "examples" / "dc-spect-80.xlsx"
FOLDER = Path(__file__).parent / "files"
SAVED: dict[str, Book] = {}
"""What LibreOffice was given, by the name of the file that it made of it."""


def _add(name: str, book: Book, truth, *allowed: str, **more) -> None:
    file = name.replace(" ", "_") + ("" if "." in name else ".xlsx")
    SAVED[file] = book
    CASES.add(name, lambda path: shutil.copy(FOLDER / file, path), truth, *allowed, **more)


def _without_values(book: Book) -> Book:
    for sheet in book.sheets:
        for at, value in sheet.cells.items():
            if isinstance(value, Formula):
                sheet[at] = Formula(value.text)
    return book


def _stale() -> Book:
    book = users()
    book["Main"]["P4"] = 3.1
    return book


def _formats(code: str, unit: str) -> Book:
    book = one_sheet(BIG, unit=unit)
    for column in ONE_SHEET_COLUMNS.values():
        for row in range(2, 6):
            book.sheets[0].formats[f"{column}{row}"] = code
    return book


def _merged(text: str, unit: str) -> Book:
    book = one_sheet(BIG, unit=unit, top=2)
    book.sheets[0]["B1"] = text
    book.sheets[0].merged.append("B1:I1")
    return book


def _noted() -> Book:
    book = one_sheet(BIG, unit="cm")
    book.sheets[0].notes["B1"] = "in cm"
    return book


def _hidden() -> Book:
    book = users(scanner(SCANNER.centers * 1.1))
    book["Coordinates"].state = "hidden"
    shown = users()["Coordinates"]
    shown.name = "Coordinates 2022"
    book.sheets.append(shown)
    return typed(book)


_add("users", _without_values(users()), SCANNER, RIGHT)
_add(
    "users calculated anew",
    _stale(),
    scanner(d=[2.3, 3.1, 2.3, 2.3]),
    RIGHT,
    REFUSED,
    place="Coordinates!",
    unmappable="stale values",
)
_add("one sheet", one_sheet(BIG), BIG, RIGHT)
_add("headings in cm", one_sheet(BIG, {q: f"{SYMBOLS[q]} (cm)" for q in ONE_SHEET_COLUMNS}, "cm"), BIG, RIGHT)
_add(
    "number format in cm",
    _formats('0.000" cm"', "cm"),
    BIG,
    RIGHT,
    REFUSED,
    place="Geometry!",
    columns=one_sheet_map("cm"),
)
_add(
    "number format in mm", _formats('0.000" mm"', "mm"), BIG, RIGHT, REFUSED, place="Geometry!", columns=one_sheet_map()
)
_add(
    "cm merged over the headings",
    _merged("cm", "cm"),
    BIG,
    RIGHT,
    REFUSED,
    place="Geometry!",
    columns=one_sheet_map("cm", 3, 6),
)
_add("note in cm", _noted(), BIG, REFUSED, WARNED_OF, place="Geometry!B1", columns=one_sheet_map("cm"))
_add(
    "hidden Coordinates",
    _hidden(),
    SCANNER,
    REFUSED,
    place="Coordinates",
    columns=users_map(position={"sheet": "Coordinates 2022"}),
)
_add("users.xls", users(), SCANNER, REFUSED, place="scanner.xlsx", unmappable="an .xls file under another name")
_add("users.ods", users(), SCANNER, REFUSED, place="scanner.xlsx", unmappable="an .ods file under another name")
_add("one sheet.csv", one_sheet(BIG), BIG, REFUSED, place="scanner.xlsx", unmappable="a .csv file under another name")
_add(
    "one sheet.html", one_sheet(BIG), BIG, REFUSED, place="scanner.xlsx", unmappable="an .html file under another name"
)


def make() -> None:
    """Have LibreOffice save every one of `SAVED`."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        given = Path(name) / "given"
        given.mkdir()
        for file, book in SAVED.items():
            by_hand(book, given / f"{Path(file).stem}.xlsx")
        shutil.copy(REAL, given / REAL.name)
        for suffix in sorted({Path(file).suffix for file in SAVED}):
            files = [given / f"{Path(file).stem}.xlsx" for file in [*SAVED, REAL.name] if file.endswith(suffix)]
            command = ["soffice", f"-env:UserInstallation={(Path(name) / 'profile').as_uri()}", "--headless"]
            subprocess.run(
                [*command, "--convert-to", suffix[1:], "--outdir", str(FOLDER), *map(str, files)], check=True
            )
    missing = [file for file in SAVED if not (FOLDER / file).is_file()]
    sys.exit(f"not saved: {missing}" if missing else 0)


if __name__ == "__main__":
    make()
