"""Which column holds which quantity: found by its symbol (x1) or description (x coordinate at center of hole)."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from .book import Book, Sheet

HEADING_ROWS = 20
_ROWS_APART = 3
"""A symbol row and a description row that are further apart do not belong together."""

POSITION = ("x1", "y1", "z1")
DIMENSIONS = ("d", "R", "Ld", "Td")
LENGTHS = (*POSITION, *DIMENSIONS, "b", "l", "H", "x2", "y2", "z2", "range")

_SYMBOLS = {
    **{name.casefold(): name for name in (*POSITION, *DIMENSIONS, "b", "l", "x2", "y2", "z2")},
    "l+b+td": "H",
    "b+l+td": "H",
}
_NUMBER_HEADINGS = {
    *(
        "definitions",
        "number",
        "no",
        "no.",
        "nr",
        "nr.",
        "#",
        "module",
        "module number",
        "module no",
        "module no.",
    ),
    *("module #", "pinhole number", "pinhole no", "pinhole no.", "camera", "camera number"),
}
# Words of which a description has one of each set, and none after "not".
_DESCRIPTIONS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("d", ("diameter", "hole pinhole aperture"), "detector crystal collimator"),
    ("R", ("radius", "roi interest"), ""),
    ("Ld", ("side width", "detector crystal"), ""),
    ("Td", ("thickness", "detector crystal"), ""),
    ("l", ("length", "collimator"), "detector crystal"),
    ("b", ("distance", "hole pinhole", "heart isocenter isocentre origin"), ""),
    ("azimuth", ("azimuth",), "detector crystal"),
    ("elevation", ("elevation",), "detector crystal"),
    ("range", ("range", "hole pinhole"), "detector crystal"),
)
EXPECTED_HEADINGS = {
    **{f"{axis}1": f"{axis} coordinate value at center of hole" for axis in "xyz"},
    "d": "diameter of pinhole",
    "R": "radius of spherical region of interest",
    "Ld": "length of side of detector crystal",
    "Td": "thickness of detector crystal",
}

_LONGEST_HEADING = 120
_UNIT = re.compile(r"[(\[]\s*([a-zµ°\"]+)\.?\s*[)\]]", re.IGNORECASE)
_MILLIMETRES = {"mm", "millimeter", "millimeters", "millimetre", "millimetres"}
_OTHER_LENGTHS = {
    "cm",
    "m",
    "um",
    "µm",
    "μm",
    "in",
    "inch",
    "inches",
    '"',
    "ft",
    "meter",
    "meters",
    "metre",
    "metres",
}
_OTHER_LENGTHS |= {"centimeter", "centimeters", "centimetre", "centimetres"}
_DEGREES = {"deg", "degree", "degrees", "°"}
_WORDS = "|".join(sorted(map(re.escape, (_MILLIMETRES | _OTHER_LENGTHS | _DEGREES) - {'"'}), key=len, reverse=True))
# Of the units that are known, also "in cm" and "(all in cm)", and at the end "d, cm", "d/cm", "d_cm" and "d cm".
_UNITS = (
    _UNIT,
    re.compile(rf"[(\[][^)\]]*\s({_WORDS})\.?\s*[)\]]", re.IGNORECASE),
    re.compile(rf"\bin\s+({_WORDS})(?![\w°])", re.IGNORECASE),
    re.compile(rf"(?<=\w)(?:\s*[,;:/_]\s*|\s+)({_WORDS})\.?\s*$", re.IGNORECASE),
)


def quantity_of(text: Any) -> str | None:
    """The quantity that a heading names, by symbol or description; None for anything else."""
    if not isinstance(text, str) or len(text) > _LONGEST_HEADING:
        return None
    for unit in _UNITS:
        text = unit.sub(" ", text)
    plain = " ".join(unicodedata.normalize("NFKC", text).casefold().split()).strip("'\"` ")
    if plain in _NUMBER_HEADINGS:
        return "number"
    symbol = re.sub(r"[\s_'\"]", "", plain)
    if symbol in _SYMBOLS:
        return _SYMBOLS[symbol]
    words = set(re.findall(r"[a-z]+", plain))
    axes = words & {"x", "y", "z"}
    if len(axes) == 1 and words & {"coordinate", "position", "value"}:
        if words & {"detector", "crystal"}:
            return f"{axes.pop()}2"
        return f"{axes.pop()}1" if words & {"hole", "pinhole"} else None
    for quantity, needed, excluded in _DESCRIPTIONS:
        if all(words & set(group.split()) for group in needed) and not words & set(excluded.split()):
            return quantity
    return None


def _units(heading: str) -> set[str]:
    return {match[1].casefold() for unit in _UNITS for match in unit.finditer(heading)}


@dataclass(frozen=True)
class Table:
    """A sheet's table under its heading rows.

    Attributes
    ----------
    sheet : Sheet
    heading_rows : tuple of int
    headings : tuple of (row, column, quantity)
    first_row : int
        The first row below the headings.
    headed : frozenset of int
        Columns with any text in the heading rows.
    """

    sheet: Sheet
    heading_rows: tuple[int, ...]
    headings: tuple[tuple[int, int, str], ...]
    first_row: int
    headed: frozenset[int]

    @property
    def quantities(self) -> set[str]:
        """What the headings name."""
        return {quantity for _, _, quantity in self.headings}

    def column(self, quantity: str) -> int | None:
        """The column of `quantity`, None if there is none; `InputError` where the headings are at odds."""
        mine = [(row, column) for row, column, name in self.headings if name == quantity]
        if not mine:
            return None
        place, what = self.sheet.place, f"{self.sheet.book.path.name}: {self.sheet.place(*mine[0])}"
        for row, column in mine:
            if column != mine[0][1]:
                raise InputError(
                    f"{what} and {place(row, column)} are both headed as {quantity}, expected one such column"
                )
        for row, column, name in self.headings:
            if column == mine[0][1] and name != quantity:
                raise InputError(
                    f"{what} is headed as {quantity} but {place(row, column)} as {name}, expected one of them"
                )
        self._check_unit(quantity, mine)
        return mine[0][1]

    def in_degrees(self, quantity: str) -> bool:
        """Whether the heading of an angle says so."""
        return any(
            _units(self._text(row, column)) & _DEGREES for row, column, name in self.headings if name == quantity
        )

    def number_columns(self) -> list[int]:
        """Columns that may hold the modules' numbers: those headed so, then unheaded ones at the left."""
        headed = [column for _, column, quantity in self.headings if quantity == "number"]
        left = min((column for _, column, quantity in self.headings if quantity != "number"), default=1)
        return [*dict.fromkeys(headed), *(column for column in range(1, left) if column not in self.headed)]

    def _text(self, row: int, column: int) -> str:
        return str(self.sheet.stored.get((row, column), ""))

    def _check_unit(self, quantity: str, headings: list[tuple[int, int]]) -> None:
        for row, column in headings:
            units = _units(self._text(row, column)) & _OTHER_LENGTHS
            if quantity in LENGTHS and units:
                raise InputError(
                    f"{self.sheet.book.path.name}: {self.sheet.place(row, column)} heads {quantity} in "
                    f"{min(units)}, expected millimetres"
                )


def tables(book: Book) -> list[Table]:
    """The table of each sheet that has one, in the workbook's order."""
    return [table for sheet in book.sheets.values() if (table := _table(sheet)) is not None]


def _table(sheet: Sheet) -> Table | None:
    rows: dict[int, dict[int, str]] = {}
    top = sheet.top(HEADING_ROWS)
    for (row, column), text in top.items():
        if (quantity := quantity_of(text)) is not None:
            rows.setdefault(row, {})[column] = quantity

    def matches(row: int) -> tuple[int, int]:
        return len(set(rows[row].values()) - {"number"}), -row

    if not rows:
        return None
    main = max(rows, key=matches)
    if not matches(main)[0]:
        return None
    beside = [row for row in rows if row != main and abs(row - main) <= _ROWS_APART and matches(row)[0]]
    chosen = sorted([main, max(beside, key=matches)] if beside else [main])
    headings = tuple((row, column, quantity) for row in chosen for column, quantity in rows[row].items())
    headed = frozenset(column for row, column in top if row in chosen and isinstance(top[row, column], str))
    return Table(sheet, tuple(chosen), headings, chosen[-1] + 1, headed)
