"""References in formulas, such as ``B3``, ``'My sheet'!$B$3:$B$82``, ``Main!A:C`` or ``3:5``."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

MAX_ROW = 1_048_576
MAX_COLUMN = 16_384

_SHEET = r"(?:(?P<sheet>'(?:[^'\[\]]|'')+'|[^'!\[\]()\s]+)!)?"
_AREAS = tuple(
    re.compile(_SHEET + area, re.IGNORECASE)
    for area in (
        r"\$?(?P<left>[A-Z]{1,3})\$?(?P<top>\d{1,7})(?::\$?(?P<right>[A-Z]{1,3})\$?(?P<bottom>\d{1,7}))?",
        r"\$?(?P<left>[A-Z]{1,3}):\$?(?P<right>[A-Z]{1,3})",
        r"\$?(?P<top>\d{1,7}):\$?(?P<bottom>\d{1,7})",
    )
)


class Reference(NamedTuple):
    """An area of cells, rows and columns counted from 1.

    ``sheet`` is None for the formula's own, "First:Last" for an area through several sheets.
    """

    sheet: str | None
    top: int
    left: int
    bottom: int
    right: int


@lru_cache(maxsize=2**15)
def reference(text: str) -> Reference | None:
    """What `text` refers to; None for a name, a cell of another file or anything else."""
    from openpyxl.utils import column_index_from_string as column

    match = next((found for area in _AREAS if (found := area.fullmatch(text))), None)
    if match is None:
        return None
    parts = match.groupdict()
    sheet = parts["sheet"]
    if sheet is not None and sheet.startswith("'"):
        sheet = sheet[1:-1].replace("''", "'")
    left, top, right, bottom = (parts.get(side) for side in ("left", "top", "right", "bottom"))
    columns = [1, MAX_COLUMN] if left is None else sorted([column(left.upper()), column((right or left).upper())])
    rows = [1, MAX_ROW] if top is None else sorted([int(top), int(bottom or top)])
    if rows[0] < 1 or rows[1] > MAX_ROW or columns[1] > MAX_COLUMN:
        return None
    return Reference(sheet, rows[0], columns[0], rows[1], columns[1])
