"""Workbooks that LibreOffice has saved, kept in files/ since not every machine has it.

``python -m tests.core.nasty.by_libreoffice`` in the repository's root makes them again, with soffice on the path.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from .decorations import SAME, changed_since, further_sheet, number_format, text
from .layouts import BIG, GEOMETRY, SCANNER, USERS, Draft, Layout, laid_out, scanner
from .sheets import Formula, by_hand

REAL = Path(__file__).parents[3] / "examples" / "dc-spect-80.xlsx"
FOLDER = Path(__file__).parent / "files"
DRAFTS: dict[str, Draft] = {}
"""What LibreOffice was given, by the name of the file that it made of it."""


def _add(file: str, layout: Layout, *decoration: Any) -> Draft:
    draft = DRAFTS[file] = laid_out(layout, SCANNER if layout.formulas else BIG)
    if decoration:
        decoration[0](draft, *decoration[1:])
    return draft


CENTIMETRES = Layout(**{**vars(GEOMETRY), "unit": "cm"})
BAND = Layout(**{**vars(GEOMETRY), "top": 1})
users = _add("users.xlsx", USERS)
for sheet in users.book.sheets:
    sheet.cells = {at: Formula(v.text) if isinstance(v, Formula) else v for at, v in sheet.cells.items()}
stale = _add("users_calculated_anew.xlsx", USERS, changed_since, "d")
stale.truth, stale.clear, stale.mappable = scanner(d=[2.3 * 1.3, 2.3, 2.3, 2.3]), True, False
_add("one_sheet.xlsx", GEOMETRY)
_add("headings_in_cm.xlsx", CENTIMETRES)
_add("number_format_in_cm.xlsx", GEOMETRY, number_format, '0.000" cm"', "cm", "all")
_add("number_format_in_mm.xlsx", GEOMETRY, number_format, '0.000" mm"', SAME, "all")
_add("cm_merged_over_the_headings.xlsx", BAND, text, "band", "cm", "cm")
_add("note_in_cm.xlsx", GEOMETRY, text, "note of a heading", "in cm", "cm")
hidden = _add("hidden_Coordinates.xlsx", USERS, further_sheet, "Coordinates 2022", "other numbers", "visible")
hidden.book["Coordinates"].state = "hidden"
UNREADABLE = ("users.xls", "users.ods", "one_sheet.csv", "one_sheet.html")
"""Files that LibreOffice made of the same workbooks, and that are refused."""


def make() -> None:
    """Have LibreOffice save every one of `DRAFTS`."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "given"
        folder.mkdir()
        for file, draft in DRAFTS.items():
            by_hand(draft.book, folder / file)
        shutil.copy(REAL, folder / REAL.name)
        saved = [*DRAFTS, REAL.name, *UNREADABLE]
        for suffix in sorted({Path(file).suffix for file in saved}):
            files = [folder / f"{Path(file).stem}.xlsx" for file in saved if file.endswith(suffix)]
            command = ["soffice", f"-env:UserInstallation={(Path(name) / 'profile').as_uri()}", "--headless"]
            subprocess.run(
                [*command, "--convert-to", suffix[1:], "--outdir", str(FOLDER), *map(str, files)], check=True
            )
    missing = [file for file in saved if not (FOLDER / file).is_file()]
    sys.exit(f"not saved: {missing}" if missing else 0)


if __name__ == "__main__":
    make()
