"""What the columns of a geometry workbook are: one table of quantities, their headings and units.

A heading is understood as a whole or not at all: one of the texts below (blanks and case aside), alone or with a unit
that is known: "x1 (mm)", "x1 [cm]", "x1, cm", "x1/cm", "x1 in cm".
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

LENGTH_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "µm": 1e-3} | {
    # In column maps alone, not in headings.
    "dm": 100.0,
    "ft": 304.8,
    "mil": 0.0254,
    "0.1 mm": 0.1,
}
"""Unit -> mm."""
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180}
"""Unit -> rad."""

_UNIT_WORDS = {
    "mm": "mm millimeter millimeters millimetre millimetres",
    "cm": "cm centimeter centimeters centimetre centimetres",
    "m": "m meter meters metre metres",
    "in": "in inch inches",
    "µm": "µm um micrometer micrometers micrometre micrometres micron microns",
    "rad": "rad radian radians",
    "deg": "deg degree degrees °",
}
_OTHER_UNIT_WORDS = (
    "dm decimeter decimeters decimetre decimetres dezimeter zentimeter millimeter km kilometer kilometers kilometre "
    "kilometres nm nanometer nanometers nanometre nanometres angstrom angstroms å mil mils thou ft foot feet yd yard "
    "yards zoll pouce pouces pollice pollici pulgada pulgadas px pixel pixels voxel voxels unit units einheit "
    "einheiten unité unités scale scaled scaling maßstab centímetros centimetros milímetros centimètres millimètres "
    "centimetri millimetri см мм дюйм дюймы сантиметры миллиметры 厘米 公分 毫米 英寸 センチ ミリ インチ"
)
"""Words in notes that may say in what the lengths are, and that nothing here can account for."""
UNIT_WORDS = frozenset(["unit", "units", "einheit", "einheiten", "unité", "unités"])
"""Of these, those that a unit in the same row accounts for: "Units: mm"."""


@dataclass(frozen=True)
class Quantity:
    """What a column may hold.

    Attributes
    ----------
    name : str
        Its symbol, and its name in messages and column maps.
    headings : tuple of str
        The texts that head it. Those of a single letter count as they are written, others whatever their case.
    kind : "length" or "angle"
    telling : str
        Words of a heading that is not understood which may mean this quantity all the same.
    plausible : (lowest, highest), or None
        mm; what lies outside is warned of.
    """

    name: str
    headings: tuple[str, ...]
    kind: Literal["length", "angle"] = "length"
    telling: str = ""
    plausible: tuple[float, float] | None = None

    @property
    def units(self) -> dict[str, float]:
        """Unit -> mm or rad; the first is that of a heading without one."""
        return LENGTH_UNITS if self.kind == "length" else ANGLE_UNITS


def _coordinate(axis: str, end: str, places: str) -> Quantity:
    headings = [f"{axis}{end}"]
    for place in places.split(", "):
        headings += [f"{axis} coordinate value at {place}", f"{axis} coordinate at {place}"]
        headings += [f"{axis} coordinate of {place}", f"{axis} position of {place}"]
    return Quantity(f"{axis}{end}", tuple(headings), telling=f"{axis} {axis}1 {axis}2 coordinate coordinates position")


_HOLES = "center of hole, centre of hole, center of pinhole, centre of pinhole, pinhole"
_ENDS = "end of detector"
_HEART = ("heart", "isocenter", "isocentre")

_TABLE = (
    *(_coordinate(axis, "1", _HOLES) for axis in "xyz"),
    Quantity(
        "d",
        ("d", "diameter of pinhole", "pinhole diameter", "diameter of hole", "hole diameter"),
        telling="d diameter bore",
        plausible=(0.05, 50),
    ),
    Quantity(
        "R",
        ("R", "radius of spherical region of interest", "radius of region of interest", "radius of roi", "roi radius"),
        telling="r radius roi",
        plausible=(5, 1000),
    ),
    Quantity(
        "Ld",
        ("Ld", "length of side of detector crystal", "side of detector crystal", "side of crystal", "crystal side"),
        telling="ld side width size edge",
        plausible=(1, 1000),
    ),
    Quantity(
        "Td",
        ("Td", "thickness of detector crystal", "thickness of crystal", "crystal thickness"),
        telling="td thickness",
        plausible=(0.1, 200),
    ),
    Quantity(
        "l", ("l", "length of collimator", "collimator length"), telling="l length depth height", plausible=(1, 1000)
    ),
    Quantity(
        "b",
        (
            "b",
            *(
                f"distance from {c} of {h} to center of heart"
                for c in ("center", "centre")
                for h in ("hole", "pinhole")
            ),
            *(f"distance from pinhole to {to}" for to in _HEART),
            *(f"pinhole to {to} distance" for to in _HEART),
        ),
        telling="b distance",
        plausible=(40, 2000),
    ),
    Quantity("H", ("l+b+Td", "b+l+Td"), telling="td"),
    *(_coordinate(axis, "2", _ENDS) for axis in "xyz"),
    Quantity("range", ("pinhole range",), telling="range"),
    Quantity("azimuth", ("pinhole azimuth",), "angle", telling="azimuth"),
    Quantity("elevation", ("pinhole elevation",), "angle", telling="elevation"),
)
QUANTITIES = {quantity.name: quantity for quantity in _TABLE}
POSITION = ("x1", "y1", "z1")
DIMENSIONS = ("d", "R", "Ld", "Td")
NEEDED = (*POSITION, *DIMENSIONS)
DERIVED = ("b", "H", "x2", "y2", "z2", "range", "azimuth", "elevation")
"""Follow from the others; a workbook's own are only compared. In order of cause and effect, l coming after b."""

NUMBER_HEADINGS = frozenset(
    (
        *("definitions", "number", "no", "no.", "nr", "nr.", "#", "module", "modules", "module number", "module no"),
        *("module no.", "module #", "pinhole number", "pinhole no", "pinhole no.", "camera", "camera number"),
    )
)
"""Head the column of the modules' numbers."""
LABEL_HEADINGS = frozenset(
    (
        *("serial", "serial number", "serial no", "serial no.", "s/n", "sn", "label", "name", "id", "identifier"),
        *("code", "tag", "module id", "module name", "pinhole id", "pinhole name", "camera id", "camera name"),
    )
)
"""Head a column that says which module a row is of, too: two sheets must agree in it."""

_NAMES: dict[str, str] = {}
for _quantity in _TABLE:
    for _text in _quantity.headings:
        _NAMES[_text if len(_text) == 1 else _text.casefold()] = _quantity.name
_UNIT_OF = {word: unit for unit, words in _UNIT_WORDS.items() for word in words.split()}
_UNIT_OF = {unicodedata.normalize("NFKC", word).casefold(): unit for word, unit in _UNIT_OF.items()}
_OTHER_WORDS = frozenset(_OTHER_UNIT_WORDS.split()) - set(_UNIT_OF)
_TELLING = {name: frozenset(quantity.telling.split()) for name, quantity in QUANTITIES.items()}

_WITH_UNIT = re.compile(
    r"(?P<name>.+?)\s*(?:\((?:in )?(?P<a>[^()]+)\)|\[(?:in )?(?P<b>[^\[\]]+)\]|[,/]\s*(?P<c>\S+)|\sin\s(?P<d>\S+))"
)
_BRACKETED_UNIT = re.compile(r"\((?:in )?([^()]+)\)|\[(?:in )?([^\[\]]+)\]|(.+)")
_WORD = re.compile(r"[^\W\d_]+")
_IN_BRACKETS = re.compile(r"[(\[]\s*(in|m|\"|''|″)\.?\s*[)\]]")
_FILLERS = frozenset(["in", "all", "are", "is", "lengths", "length", "values", "value", "the"])
_AT_THE_END = re.compile(r"(?:^|[:=,/]\s*|\bin\s+|\d\s*)(in|m)\b\.?(?!\s*[\w\d])|\s(m)$")
_PART_OF_MILLIMETRE = re.compile(
    r"(?:\bin|[x×*/]|\bunits?\b\D*)\s*[\d.,/^-]*\d[\d.,/^-]*\s*mm\b|\bths? (?:of )?(?:a )?mm\b|tenths? of"
    r"|[x×*/÷] ?[\d.,]+ ?=|^[\d.,/^-]+ ?mm$"
)


_LITERAL = re.compile(r'"([^"]*)"|\\(.)|\[\$([^\]-]*)[^\]]*\]')
_PLACEHOLDERS = re.compile(r"\[[^\]]*\]|general|standard|e[+-]|[_*].", re.IGNORECASE)
"""Of number formats: colours and conditions, the general format, exponents, blanks and filling."""
_DIGITS = re.compile(r"[0#?.,@()+\-/ ]*")
_SCALED = re.compile(r"[0#?],+(?![0#?,])")


class Heading(NamedTuple):
    """What a heading says: the quantity, and its unit if it names one."""

    quantity: str
    unit: str | None


def plain(text: str) -> str:
    """A text as headings are compared, but for its case: compatibility forms resolved, blanks collapsed."""
    return " ".join(unicodedata.normalize("NFKC", text).split())


def understood(text: Any) -> Heading | None:
    """What a heading's text says, None where it is not understood as a whole."""
    if not isinstance(text, str):
        return None
    text = plain(text)
    name = _named(text)
    if name is not None:
        return Heading(name, None)
    match = _WITH_UNIT.fullmatch(text)
    if match is None or (name := _named(match["name"])) is None:
        return None
    unit = _UNIT_OF.get((match["a"] or match["b"] or match["c"] or match["d"]).strip().casefold())
    return Heading(name, unit) if unit in QUANTITIES[name].units else None


def _named(text: str) -> str | None:
    text = re.sub(r"\s*\+\s*", "+", text)
    return _NAMES.get(text if len(text) == 1 else text.casefold())


def unit_alone(text: Any) -> str | None:
    """The unit that a text is, as it stands in a row of units: "mm", "[mm]", "(in mm)"."""
    if not isinstance(text, str):
        return None
    match = _BRACKETED_UNIT.fullmatch(plain(text).casefold())
    return None if match is None else _UNIT_OF.get((match[1] or match[2] or match[3]).strip())


def is_number_heading(text: Any) -> bool:
    """Whether a text heads the modules' numbers."""
    return isinstance(text, str) and plain(text).casefold() in NUMBER_HEADINGS


def is_label_heading(text: Any) -> bool:
    """Whether a text heads other names of the modules."""
    return isinstance(text, str) and plain(text).casefold() in LABEL_HEADINGS


def may_mean(text: Any) -> list[str]:
    """The quantities that a heading which is not understood may be about, by its words."""
    if not isinstance(text, str):
        return []
    words = set(re.findall(r"[^\W_]+", plain(text).casefold()))
    return [name for name, telling in _TELLING.items() if words & telling]


def shown_as_stored(number_format: str, unit: str) -> bool:
    """Whether a number format shows a number as it is, alone or with its unit."""
    for section in number_format.split(";"):
        for literal in _LITERAL.finditer(section):
            text = literal[1] or literal[2] or literal[3] or ""
            if re.sub(r"[\s()+\-:/]", "", text) and (unit_alone(text) or plain(text)) != unit:
                return False
        rest = _PLACEHOLDERS.sub("", _LITERAL.sub("", section))
        if _SCALED.search(rest) or not _DIGITS.fullmatch(rest.replace(";", "")):
            return False
    first = _PLACEHOLDERS.sub("", number_format.split(";")[0].replace('"', "").replace("\\", ""))
    return not first.lstrip().startswith(("-", "("))


def units_in(text: Any, alone: bool = False) -> list[str]:
    """The length units that a note speaks of: "mm" ..., or the word itself where nothing here can account for it.

    With `alone` only if the text is nothing but that.
    """
    if not isinstance(text, str):
        return []
    folded = plain(text).casefold()
    words = _WORD.findall(re.sub(r"['’](?=\w)", "", folded))
    if alone:
        whole = unit_alone(text)
        said = [] if re.search(r"\d", folded) else [word for word in words if word not in _FILLERS]
        other = [_UNIT_OF.get(word, word) for word in said if word in _UNIT_OF or word in _OTHER_WORDS]
        found = [whole] if whole else other if len(other) == len(said) else []
    else:
        # "in" is a word, too, and letters are names: these only in brackets, after a number or "in", or at the end.
        plainly = [word for word in words if word not in ("in", "m")]
        found = [_UNIT_OF.get(word, word) for word in plainly if word in _UNIT_OF or word in _OTHER_WORDS]
        found += ["in" if mark != "m" else "m" for mark in _IN_BRACKETS.findall(folded)]
        found += [a or b for a, b in _AT_THE_END.findall(plain(text))]
        if _PART_OF_MILLIMETRE.search(folded):
            found.append(folded)
    units = [unit for unit in dict.fromkeys(found) if unit not in ANGLE_UNITS]
    return [unit for unit in units if unit not in UNIT_WORDS] or units
