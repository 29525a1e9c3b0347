"""Meaning of the texts in a geometry workbook: headings, units, notes and number formats.

A heading is understood as a whole or not at all: it must be one of the headings of a scanner's columns, in any case and
with any blanks, alone or with a known unit: "x1 (mm)", "x1 [cm]", "x1, cm", "x1/cm", "x1 in cm".
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
"""Headings of the column of the modules' numbers."""
_LABEL_HEADINGS = (
    "serial, serial number, serial no, serial no., s/n, sn, label, name, id, identifier, code, tag, module id, "
    "module name, pinhole id, pinhole name, camera id, camera name"
)
"""Headings of a column that also says which module a row belongs to: two sheets must agree in it."""
UNIT_WORDS = frozenset(["unit", "units", "einheit", "einheiten", "unité", "unités"])
"""Words in notes that need no unit of their own if the same row has one: "Units: mm"."""

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
"""Words that distinguish several values of one quantity."""

_UNIT_OF = {
    unicodedata.normalize("NFKC", word).casefold(): unit
    for unit, words in _UNIT_WORDS.items()
    for word in words.split()
}
"""Case-folded word -> unit."""
_OTHER_WORDS = frozenset(_OTHER_UNIT_WORDS.split()) - set(_UNIT_OF)

_WITH_UNIT = re.compile(
    r"(?P<name>.+?)\s*(?:\((?:in )?(?P<a>[^()]+)\)|\[(?:in )?(?P<b>[^\[\]]+)\]|[,/]\s*(?P<c>\S+)|\sin\s(?P<d>\S+))"
)
_BRACKETED_UNIT = re.compile(r"\((?:in )?([^()]+)\)|\[(?:in )?([^\[\]]+)\]|(.+)")
_WORD = re.compile(r"[^\W\d_]+")
_FILLERS = frozenset(["in", "all", "are", "is", "lengths", "length", "values", "value", "the"])
"""Words that a note about nothing but a unit may have beside it."""
# "in" is also a word and "m" a letter: they are units only in brackets, after a number or "in", or at the end.
_IN_BRACKETS = re.compile(r"[(\[]\s*(in|m|\"|''|″)\.?\s*[)\]]")
_AT_THE_END = re.compile(r"(?:^|[:=,/]\s*|\bin\s+|\d\s*)(in|m)\b\.?(?!\s*[\w\d])|\s(m)$")
_PART_OF_MILLIMETRE = re.compile(
    r"(?:\bin|[x×*/]|\bunits?\b\D*)\s*[\d.,/^-]*\d[\d.,/^-]*\s*mm\b|\bths? (?:of )?(?:a )?mm\b|tenths? of"
    r"|[x×*/÷] ?[\d.,]+ ?=|^[\d.,/^-]+ ?mm$"
)

_LITERAL = re.compile(r'"([^"]*)"|\\(.)|\[\$([^\]-]*)[^\]]*\]')
"""Text that a number format shows beside the number."""
_PLACEHOLDERS = re.compile(r"\[[^\]]*\]|general|standard|e[+-]|[_*].", re.IGNORECASE)
"""Parts of a number format that do not change the number: colours, conditions, "general", exponents, blanks, filling."""
_DIGITS = re.compile(r"[0#?.,@()+\-/ ]*")
"""All that is left of a number format that shows the number as it is."""
_SCALED = re.compile(r"[0#?],+(?![0#?,])")
"""Commas that divide the number by 1000 each."""


class Heading(NamedTuple):
    """Meaning of a heading."""

    name: str
    """Name of the scanner's column."""
    unit: str | None
    """Unit that the heading states, None if it states none."""


def normalize(text: str) -> str:
    """Return a text with its characters (NFKC) and blanks normalised; its case is kept."""
    return " ".join(unicodedata.normalize("NFKC", text).split())


def quote_text(text: str) -> str:
    """Return a cell's text as messages show it: on one line, in quotes, of at most 60 characters."""
    text = normalize(text)
    return repr(text if len(text) <= 60 else text[:59] + "…")


class Vocabulary:
    """Headings that name the columns of a kind of scanner."""

    def __init__(self, columns: ColumnTable) -> None:
        self.columns = columns
        self._names = {_fold_case(text): column.name for column in columns.values() for text in column.headings}
        """Case-folded heading -> name of the column."""
        self._hints = {name: frozenset(column.hints.split()) for name, column in columns.items()}
        words = [_VERSIONS, *self._names, *_UNIT_OF, *(column.hints for column in columns.values())]
        self._vague_words = frozenset(_WORD.findall(" ".join(words)))
        """Words that do not tell a column from other columns of the workbook."""
        self._unread = {text.casefold() for column in columns.unread for text in column.headings}

    def parse_heading(self, text: str) -> Heading | None:
        """Return the column and the unit that a heading states; None if it is not understood as a whole."""
        text = normalize(text)
        if (name := self._find_name(text)) is not None:
            return Heading(name, None)
        match = _WITH_UNIT.fullmatch(text)
        if match is None or (name := self._find_name(match["name"])) is None:
            return None
        unit = _UNIT_OF.get((match["a"] or match["b"] or match["c"] or match["d"]).strip().casefold())
        return Heading(name, unit) if unit in self.columns[name].units else None

    def _find_name(self, text: str) -> str | None:
        """Return the name of the column that a heading without unit names, None if it names none."""
        return self._names.get(_fold_case(re.sub(r"\s*\+\s*", "+", text)))

    def suggest_columns(self, text: str) -> list[str]:
        """Return the names of the columns that a heading may be about, by its words."""
        words = set(re.findall(r"[^\W_]+", normalize(text).casefold()))
        return [name for name, hints in self._hints.items() if words & hints]

    def mistakable_columns(self, text: str) -> list[str]:
        """Return the typed columns that a heading which is not understood may be mistaken for.

        Such a heading contains a heading of the column, or only vague words: "x1 (old)", "measured x", but not "z axis of
        the ray".
        """
        words = re.findall(r"[^\W_]+", normalize(text))
        contained = {self._find_name(" ".join(words[i : i + n])) for i in range(len(words)) for n in range(1, 12)}
        is_vague = self._vague_words.issuperset(_WORD.findall(normalize(text).casefold()))
        return [n for n in self.suggest_columns(text) if n in self.columns.typed and (is_vague or n in contained)]

    def is_unrelated(self, text: str) -> bool:
        """Return whether a heading is known to name none of the columns that are read."""
        return is_number_heading(text) or is_label_heading(text) or normalize(text).casefold() in self._unread


@lru_cache(maxsize=64)
def get_vocabulary(columns: ColumnTable) -> Vocabulary:
    """Return the vocabulary of a kind of scanner, built once for each of their tables of columns."""
    return Vocabulary(columns)


def _fold_case(text: str) -> str:
    """Return a heading without its case; a heading of one letter keeps it, since d and D are two symbols."""
    return text if len(text) == 1 else text.casefold()


def parse_unit(text: str) -> str | None:
    """Return the unit that a text consists of, such as "mm", "[mm]" or "(in mm)"; None for any other text."""
    match = _BRACKETED_UNIT.fullmatch(normalize(text).casefold())
    return None if match is None else _UNIT_OF.get((match[1] or match[2] or match[3]).strip())


def is_number_heading(text: str) -> bool:
    """Return whether a text heads the column of the modules' numbers."""
    return normalize(text).casefold() in _NUMBER_HEADINGS.split(", ")


def is_label_heading(text: str) -> bool:
    """Return whether a text heads a column of other names of the modules."""
    return normalize(text).casefold() in _LABEL_HEADINGS.split(", ")


def units_mentioned(text: str, alone: bool = False) -> list[str]:
    """Return the length units that a note mentions; a unit that is not supported is returned as the word in the note.

    With `alone`, a note that says more than units and filler words mentions none.
    """
    folded = normalize(text).casefold()
    words = _WORD.findall(re.sub(r"['’](?=\w)", "", folded))
    if alone:
        unit = parse_unit(text)
        significant = [] if re.search(r"\d", folded) else [word for word in words if word not in _FILLERS]
        unit_words = _select_units(significant)
        candidates = [unit] if unit else unit_words if len(unit_words) == len(significant) else []
    else:
        candidates = _select_units(word for word in words if word not in ("in", "m"))
        candidates += ["in" if mark != "m" else "m" for mark in _IN_BRACKETS.findall(folded)]
        candidates += [a or b for a, b in _AT_THE_END.findall(normalize(text))]
        if _PART_OF_MILLIMETRE.search(folded):
            candidates.append(folded)
    units = [unit for unit in dict.fromkeys(candidates) if unit not in ANGLE_UNITS]
    return [unit for unit in units if unit not in UNIT_WORDS] or units


def _select_units(words: Iterable[str]) -> list[str]:
    """Return the units among some words; other words that speak of a unit or a scale are returned as they stand."""
    return [_UNIT_OF.get(word, word) for word in words if word in _UNIT_OF or word in _OTHER_WORDS]


def shows_as_stored(number_format: str, unit: str) -> bool:
    """Return whether a number format shows a number as it is stored, alone or followed by `unit`."""
    for section in number_format.split(";"):
        for literal in _LITERAL.finditer(section):
            text = literal[1] or literal[2] or literal[3] or ""
            if re.sub(r"[\s()+\-:/]", "", text) and (parse_unit(text) or normalize(text)) != unit:
                return False
        digits = _PLACEHOLDERS.sub("", _LITERAL.sub("", section))
        if _SCALED.search(digits) or not _DIGITS.fullmatch(digits.replace(";", "")):
            return False
    first = _PLACEHOLDERS.sub("", number_format.split(";")[0].replace('"', "").replace("\\", ""))
    return not first.lstrip().startswith(("-", "("))
