"""What the texts of a geometry workbook say: headings, units, notes and number formats.

A heading is understood as a whole or not at all: it is one of those that the columns of a kind of scanner have (blanks
and case aside), alone or with a known unit: "x1 (mm)", "x1 [cm]", "x1, cm", "x1/cm", "x1 in cm".
"""

import re
import unicodedata
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from ..geometry.columns import ANGLE_UNITS, ColumnTable

_NUMBER_HEADINGS = (
    "definitions, number, no, no., nr, nr., #, module, modules, module number, module no, module no., module #, "
    "pinhole number, pinhole no, pinhole no., camera, camera number"
)
"""Head the column of the modules' numbers."""
_LABEL_HEADINGS = (
    "serial, serial number, serial no, serial no., s/n, sn, label, name, id, identifier, code, tag, module id, "
    "module name, pinhole id, pinhole name, camera id, camera name"
)
"""Head a column that also says which module a row belongs to: two sheets must agree in it."""
UNIT_WORDS = frozenset(["unit", "units", "einheit", "einheiten", "unité", "unités"])
"""Words of notes that a unit in the same row explains: "Units: mm"."""

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
"""Words that speak of a unit or a scale which is not supported."""
_VERSIONS = "actual cad cmm corrected effective final half inner max mean measured new nominal old outer surveyed true"
"""Words that say which one of several values of a quantity a column holds."""

_UNIT_OF = {
    unicodedata.normalize("NFKC", word).casefold(): unit
    for unit, words in _UNIT_WORDS.items()
    for word in words.split()
}
_OTHER_WORDS = frozenset(_OTHER_UNIT_WORDS.split()) - set(_UNIT_OF)

_WITH_UNIT = re.compile(
    r"(?P<name>.+?)\s*(?:\((?:in )?(?P<a>[^()]+)\)|\[(?:in )?(?P<b>[^\[\]]+)\]|[,/]\s*(?P<c>\S+)|\sin\s(?P<d>\S+))"
)
_BRACKETED_UNIT = re.compile(r"\((?:in )?([^()]+)\)|\[(?:in )?([^\[\]]+)\]|(.+)")
_WORD = re.compile(r"[^\W\d_]+")
_FILLERS = frozenset(["in", "all", "are", "is", "lengths", "length", "values", "value", "the"])
# "in" is also a word and "m" a letter: they are units in brackets, or after a number or "in", or at the end.
_IN_BRACKETS = re.compile(r"[(\[]\s*(in|m|\"|''|″)\.?\s*[)\]]")
_AT_THE_END = re.compile(r"(?:^|[:=,/]\s*|\bin\s+|\d\s*)(in|m)\b\.?(?!\s*[\w\d])|\s(m)$")
_PART_OF_MILLIMETRE = re.compile(
    r"(?:\bin|[x×*/]|\bunits?\b\D*)\s*[\d.,/^-]*\d[\d.,/^-]*\s*mm\b|\bths? (?:of )?(?:a )?mm\b|tenths? of"
    r"|[x×*/÷] ?[\d.,]+ ?=|^[\d.,/^-]+ ?mm$"
)

# Of number formats
_LITERAL = re.compile(r'"([^"]*)"|\\(.)|\[\$([^\]-]*)[^\]]*\]')
_PLACEHOLDERS = re.compile(r"\[[^\]]*\]|general|standard|e[+-]|[_*].", re.IGNORECASE)
"""Colours and conditions, the general format, exponents, blanks and filling."""
_DIGITS = re.compile(r"[0#?.,@()+\-/ ]*")
_SCALED = re.compile(r"[0#?],+(?![0#?,])")


class Heading(NamedTuple):
    """What a heading says: the column, and its unit if it names one."""

    name: str
    unit: str | None


def plain(text: str) -> str:
    """A text without differences that do not matter, except for its case: characters and blanks normalised."""
    return " ".join(unicodedata.normalize("NFKC", text).split())


def quoted(text: str) -> str:
    """A text as messages show it."""
    text = plain(text)
    return repr(text if len(text) <= 60 else text[:59] + "…")


class Vocabulary:
    """The headings of a kind of scanner's `columns`."""

    def __init__(self, columns: ColumnTable) -> None:
        self.columns = columns
        self._named = {_folded(text): column.name for column in columns.values() for text in column.headings}
        self._hints = {name: frozenset(column.hints.split()) for name, column in columns.items()}
        words = [_VERSIONS, *self._named, *_UNIT_OF, *(column.hints for column in columns.values())]
        self._vague = frozenset(_WORD.findall(" ".join(words)))
        """Words that tell no column from the others."""
        self._unread = {text.casefold() for column in columns.unread for text in column.headings}

    def heading_of(self, text: str) -> Heading | None:
        """What a heading says, None if it is not understood as a whole."""
        text = plain(text)
        if (name := self._name_of(text)) is not None:
            return Heading(name, None)
        match = _WITH_UNIT.fullmatch(text)
        if match is None or (name := self._name_of(match["name"])) is None:
            return None
        unit = _UNIT_OF.get((match["a"] or match["b"] or match["c"] or match["d"]).strip().casefold())
        return Heading(name, unit) if unit in self.columns[name].units else None

    def _name_of(self, text: str) -> str | None:
        return self._named.get(_folded(re.sub(r"\s*\+\s*", "+", text)))

    def may_mean(self, text: str) -> list[str]:
        """The columns that a heading may be about, by its words."""
        words = set(re.findall(r"[^\W_]+", plain(text).casefold()))
        return [name for name, hints in self._hints.items() if words & hints]

    def rivals(self, text: str) -> list[str]:
        """The typed columns for whose own heading one that is not understood may be taken.

        It contains their heading, or says nothing else in its words: "x1 (old)", "measured x", but not "z axis of the ray".
        """
        words = re.findall(r"[^\W_]+", plain(text))
        within = {self._name_of(" ".join(words[i : i + n])) for i in range(len(words)) for n in range(1, 12)}
        vague = self._vague.issuperset(_WORD.findall(plain(text).casefold()))
        return [name for name in self.may_mean(text) if name in self.columns.typed and (vague or name in within)]

    def is_known(self, text: str) -> bool:
        """Whether a heading is known to say nothing of the columns."""
        return is_number_heading(text) or is_label_heading(text) or plain(text).casefold() in self._unread


@lru_cache(maxsize=64)
def vocabulary(columns: ColumnTable) -> Vocabulary:
    """The headings of these columns; made once for each table."""
    return Vocabulary(columns)


def _folded(text: str) -> str:
    """A heading as it is compared: one letter as it stands, more without case."""
    return text if len(text) == 1 else text.casefold()


def unit_of(text: str) -> str | None:
    """The unit that a text consists of: "mm", "[mm]", "(in mm)"."""
    match = _BRACKETED_UNIT.fullmatch(plain(text).casefold())
    return None if match is None else _UNIT_OF.get((match[1] or match[2] or match[3]).strip())


def is_number_heading(text: str) -> bool:
    """Whether a text heads the modules' numbers."""
    return plain(text).casefold() in _NUMBER_HEADINGS.split(", ")


def is_label_heading(text: str) -> bool:
    """Whether a text heads other names of the modules."""
    return plain(text).casefold() in _LABEL_HEADINGS.split(", ")


def units_mentioned(text: str, alone: bool = False) -> list[str]:
    """The length units that a note speaks of, if `alone` only if it says nothing else; its own word for other units."""
    folded = plain(text).casefold()
    words = _WORD.findall(re.sub(r"['’](?=\w)", "", folded))
    if alone:
        whole = unit_of(text)
        meant = [] if re.search(r"\d", folded) else [word for word in words if word not in _FILLERS]
        known = _units_among(meant)
        found = [whole] if whole else known if len(known) == len(meant) else []
    else:
        found = _units_among(word for word in words if word not in ("in", "m"))
        found += ["in" if mark != "m" else "m" for mark in _IN_BRACKETS.findall(folded)]
        found += [a or b for a, b in _AT_THE_END.findall(plain(text))]
        if _PART_OF_MILLIMETRE.search(folded):
            found.append(folded)
    units = [unit for unit in dict.fromkeys(found) if unit not in ANGLE_UNITS]
    return [unit for unit in units if unit not in UNIT_WORDS] or units


def _units_among(words: Iterable[str]) -> list[str]:
    return [_UNIT_OF.get(word, word) for word in words if word in _UNIT_OF or word in _OTHER_WORDS]


def shows_as_stored(number_format: str, unit: str) -> bool:
    """Whether a number format shows a number as it is stored, alone or with its unit."""
    for section in number_format.split(";"):
        for literal in _LITERAL.finditer(section):
            text = literal[1] or literal[2] or literal[3] or ""
            if re.sub(r"[\s()+\-:/]", "", text) and (unit_of(text) or plain(text)) != unit:
                return False
        rest = _PLACEHOLDERS.sub("", _LITERAL.sub("", section))
        if _SCALED.search(rest) or not _DIGITS.fullmatch(rest.replace(";", "")):
            return False
    first = _PLACEHOLDERS.sub("", number_format.split(";")[0].replace('"', "").replace("\\", ""))
    return not first.lstrip().startswith(("-", "("))
