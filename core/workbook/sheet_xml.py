"""The cells of a worksheet's XML, which can be changed; writing replaces only the bytes of changed cells."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

from ..errors import InputError
from .package import Element, elements, escaped, spliced, with_attribute

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
STRICT = "http://purl.oclc.org/ooxml/spreadsheetml/main"

MAX_ROW = 1_048_576
MAX_COLUMN = 16_384
At = tuple[int, int]
"""Row and column, counted from 1."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

_SHEET = re.compile(r"'((?:[^'\[\]]|'')+)'|[^'!\[\]()\s]+")
"""A sheet's name in a formula; that of another file has brackets."""


class CellError(str):
    """An error value such as #REF! or #DIV/0!."""


class Unreadable(str):
    """The text of a stored value that is neither number, text, boolean nor error."""


class Reference(NamedTuple):
    """An area of cells; ``sheet`` is None for the formula's own, "First:Last" for an area through several sheets."""

    sheet: str | None
    top: int
    left: int
    bottom: int
    right: int

    @property
    def name(self) -> str:
        """E.g. ``B3:C5``."""
        return f"{cell_name((self.top, self.left))}:{cell_name((self.bottom, self.right))}"

    @property
    def size(self) -> int:
        """How many cells it has."""
        return (self.bottom - self.top + 1) * (self.right - self.left + 1)

    def contains(self, row: int, column: int) -> bool:
        """Whether a cell is in the area, whatever its sheet."""
        return self.top <= row <= self.bottom and self.left <= column <= self.right


def cell_name(at: At) -> str:
    """E.g. ``B3``."""
    from openpyxl.utils import get_column_letter

    return f"{get_column_letter(at[1])}{at[0]}"


@lru_cache(maxsize=2**15)
def reference(text: str) -> Reference | None:
    """What ``B3``, ``'My sheet'!$B$3:$B$82``, ``A:C`` or ``3:5`` refers to; None for a name or another file's cell."""
    from openpyxl.utils import range_boundaries

    before, of_sheet, cells = text.rpartition("!")
    named = _SHEET.fullmatch(before)
    try:
        left, top, right, bottom = range_boundaries(cells)
    except ValueError:
        return None
    if (of_sheet and named is None) or (":" not in cells and None in (left, top)):
        return None
    sheet = named[1].replace("''", "'") if named and named[1] else before or None
    columns = sorted([left or 1, right or MAX_COLUMN])
    rows = sorted([1 if top is None else top, MAX_ROW if bottom is None else bottom])
    if rows[0] < 1 or rows[1] > MAX_ROW or columns[1] > MAX_COLUMN:
        return None
    return Reference(sheet, rows[0], columns[0], rows[1], columns[1])


@dataclass(frozen=True)
class _Origin:
    """The XML that a cell was read from; `group` is the index of its shared formula."""

    at: At
    element: Element
    formula: Element | None
    text: str | None
    value: Any
    group: str | None


@dataclass(frozen=True)
class Cell:
    """The content of a cell."""

    value: Any = None
    """The typed value, or the stored result of the formula: a float, str, bool, `CellError`, `Unreadable` or None."""
    formula: str | None = None
    """With its "="; a shared formula as it reads in this cell."""
    array: Reference | None = None
    """The area of the array formula or data table that the cell belongs to, if that has several cells."""
    single_array: bool = False
    """Whether the formula is an array formula of this cell alone."""
    origin: _Origin | None = field(default=None, compare=False, repr=False)

    @property
    def blank(self) -> bool:
        """Whether the cell is empty."""
        return self.value is None and self.formula is None and self.array is None

    @property
    def style(self) -> str | None:
        """The number of its style, None for the default."""
        return self.origin.element.attributes.get("s") if self.origin else None

    def typed(self, value: float | str | None) -> Cell:
        """The cell with a number or a text, or nothing, instead of its content."""
        return replace(self, value=None if value == "" else value, formula=None, single_array=False)


_BLANK = Cell()


class SheetXml:
    """The cells of a worksheet part, with the workbook's shared `strings`; messages name the `file` and the sheet.

    `cells` has the `Cell` at each (row, column), to be changed before `to_bytes`, `original` those as read, and `merged`
    the merged areas.
    """

    def __init__(self, data: bytes, strings: list[str], name: str, file: str) -> None:
        self.name, self._file, self._data = name, file, data
        self._rows: dict[int, Element] = {}
        self._in_row: dict[int, list[tuple[int, Element]]] = defaultdict(list)
        self._sheet_data: Element  # every sheet with cells has one
        self._prefix = b""
        self._dimension: Element | None = None
        self.cells: dict[At, Cell] = {}
        self.merged: list[Reference] = []
        masters: dict[str, tuple[At, str]] = {}  # of shared formulas
        row = column = 0
        for e in elements(data, f"{file}: sheet {name}"):
            if e.namespace != MAIN:
                continue
            parent = e.parent.name if e.parent is not None else ""
            if e.name == "row" and parent == "sheetData":
                row, column = int(e.attributes.get("r", row + 1)), 0
                self._rows.setdefault(row, e)
            elif e.name == "c" and parent == "row":
                named = reference(e.attributes["r"]) if "r" in e.attributes else None
                # As in spreadsheet programs, a cell's own name counts, whatever row it is in.
                at = (named.top, named.left) if named else (row, column + 1)
                column = at[1]
                self._in_row[row].append((column, e))
                self._read_cell(at, e, strings, masters)
            elif e.name == "sheetData":
                self._sheet_data = e
                self._prefix = data[e.start + 1 : e.inner].split(b"sheetData", 1)[0]
            elif e.name == "dimension":
                self._dimension = e
            elif e.name == "mergeCell" and (area := reference(e.attributes.get("ref", ""))) is not None:
                self.merged.append(area)
        self._mark_arrays()
        self.original = dict(self.cells)

    def _read_cell(self, at: At, element: Element, strings: list[str], masters: dict[str, tuple[At, str]]) -> None:
        parts = {e.name: e for e in element.children if e.namespace == MAIN}
        if at in self.cells:
            twice = f"{self.name}!{cell_name(at)} is stored twice in the file"
            raise InputError(f"{self._file}: {twice}, expected it once; Excel or LibreOffice may repair it")
        if len(parts) < sum(e.namespace == MAIN for e in element.children):
            raise InputError(f"{self._file}: {self.name}!{cell_name(at)} has several values in the file, expected one")
        value = _value(element.attributes.get("t", "n"), parts, strings)
        formula, group, text = parts.get("f"), None, None
        if formula is not None:
            text = f"={formula.text.strip()}" if formula.text.strip() else None
            if formula.attributes.get("t") == "shared":
                group = formula.attributes.get("si", "")
                if text is not None:
                    masters[group] = at, text
                elif group in masters:
                    start, text = masters[group]
                    text = moved(text, start, at)
        self.cells[at] = Cell(value, text, origin=_Origin(at, element, formula, text, value, group))

    def _mark_arrays(self) -> None:
        for at, cell in list(self.cells.items()):
            f = cell.origin.formula if cell.origin else None
            if f is None or f.attributes.get("t") not in ("array", "dataTable"):
                continue
            area = reference(f.attributes.get("ref", ""))
            if area is None or (area.top, area.left) == (area.bottom, area.right):
                self.cells[at] = replace(cell, single_array=f.attributes["t"] == "array")
                continue
            for place in self.cells:
                if place == at or area.contains(*place):
                    self.cells[place] = replace(self.cells[place], array=area)

    def cell(self, at: At) -> Cell:
        """The cell, a blank one if the sheet has none there."""
        return self.cells.get(at, _BLANK)

    def type(self, at: At, value: float | str | None) -> None:
        """Put a number or a text, or nothing, into a cell."""
        self.refuse_array(at)
        self.cells[at] = self.cell(at).typed(value)

    def copy(self, cell: Cell, start: At, to: At) -> None:
        """Put `cell`, which stood at `start`, at `to`; the relative references of its formula move along."""
        self.refuse_array(start)
        self.refuse_array(to)
        self.cells[to] = replace(cell, formula=moved(cell.formula, start, to))

    def refuse_array(self, at: At) -> None:
        """Raise `InputError` for a cell of an array formula of several cells: these change only together."""
        area = self.cell(at).array
        if area is not None:
            found = f"{self.name}!{cell_name(at)} is one cell of the array formula or data table {area.name}"
            raise InputError(f"{self._file}: {found}, expected a cell of its own: its number cannot be changed alone")

    @property
    def changed(self) -> list[At]:
        """The cells that are not as read, row by row."""
        return sorted(at for at, cell in self.cells.items() if not _same(cell, self._was(at)))

    @property
    def formulas_added_or_removed(self) -> bool:
        """Whether other cells have formulas than when read."""
        return any((self.cells[at].formula is None) != (self._was(at).formula is None) for at in self.changed)

    def _was(self, at: At) -> Cell:
        return self.original.get(at, _BLANK)

    def to_bytes(self) -> bytes:
        """The part with the changed cells."""
        changed = self.changed
        split = {group for at in changed if (group := self._group_without_text(at)) is not None}
        members = [at for at, cell in self.cells.items() if cell.origin and cell.origin.group in split]
        changes: list[tuple[int, int, bytes]] = []
        added: dict[int, list[tuple[int, bytes]]] = defaultdict(list)
        for at in sorted({*changed, *members}):
            xml, old = self._xml(at, split), self._was(at).origin
            if old is None:
                added[at[0]].append((at[1], xml))
            else:
                changes.append((old.element.start, old.element.end, xml))
        for row, cells in added.items():
            changes += self._into_row(self._rows[row], row, cells) if row in self._rows else [self._new_row(row, cells)]
        area = None if self._dimension is None else reference(self._dimension.attributes.get("ref", ""))
        if added and self._dimension is not None and area is not None:
            e, columns = self._dimension, [column for cells in added.values() for column, _ in cells]
            top, left = min(area.top, *added), min(area.left, *columns)
            grown = Reference(None, top, left, max(area.bottom, *added), max(area.right, *columns))
            changes.append((e.start, e.inner, with_attribute(self._data[e.start : e.inner], "ref", grown.name)))
        return spliced(self._data, changes)

    def _group_without_text(self, at: At) -> str | None:
        """The shared formula whose text the cell held and holds no longer."""
        was, cell = self._was(at), self.cells[at]
        if was.origin is None or was.origin.formula is None or not was.origin.formula.text.strip():
            return None
        return None if cell.formula == was.formula and cell.origin is was.origin else was.origin.group

    def _xml(self, at: At, split: set[str]) -> bytes:
        """A cell's element; shared formulas of the groups in `split` become formulas of their own."""
        cell = self.cells[at]
        origin, data, prefix = cell.origin, self._data, self._prefix
        tag = b"<%bc>" % prefix if origin is None else self._start_tag(origin.element)
        value_kept = origin is not None and cell.value is origin.value
        if origin is None or origin.at != at:
            tag = with_attribute(tag, "r", cell_name(at))
        if not value_kept or cell.value is None:
            tag = with_attribute(with_attribute(tag, "t", _stored(cell.value)[0]), "vm", None)
        if cell.formula is None:
            tag = with_attribute(tag, "cm", None)
        content = self._formula_xml(at, cell, split)
        if value_kept and origin is not None:
            inner, f = data[origin.element.inner : origin.element.close], origin.formula
            if f is not None:
                inner = inner[: f.start - origin.element.inner] + inner[f.end - origin.element.inner :]
            content += inner.strip()
        elif cell.value is not None:
            content += b"<%bv>%b</%bv>" % (prefix, escaped(_stored(cell.value)[1]), prefix)
        return tag + content + b"</%bc>" % prefix if content else tag[:-1] + b"/>"

    def _formula_xml(self, at: At, cell: Cell, split: set[str]) -> bytes:
        origin = cell.origin
        if origin is not None and origin.formula is not None and origin.text == cell.formula:
            plain = origin.formula.attributes.get("t", "normal") == "normal"
            if plain or (origin.at == at and origin.group not in split):
                return self._data[origin.formula.start : origin.formula.end]
        if cell.formula is None:
            return b""
        attributes = b' t="array" ref="%b"' % cell_name(at).encode() if cell.single_array else b""
        text = cell.formula[1:]
        if text != text.strip():
            attributes += b' xml:space="preserve"'
        return b"<%bf%b>%b</%bf>" % (self._prefix, attributes, escaped(text), self._prefix)

    def _start_tag(self, e: Element) -> bytes:
        """An element's start tag, also of an element that has no end tag yet."""
        tag = self._data[e.start : e.inner]
        return tag[:-2].rstrip() + b">" if tag.endswith(b"/>") else tag

    def _into_row(self, e: Element, row: int, cells: list[tuple[int, bytes]]) -> list[tuple[int, int, bytes]]:
        tag = with_attribute(self._start_tag(e), "spans", None)
        if e.inner == e.end:
            return [(e.start, e.end, tag + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix)]
        changes = [(e.start, e.inner, tag)]
        for column, xml in cells:
            at = min((other.start for c, other in self._in_row[row] if c > column), default=e.close)
            changes.append((at, at, xml))
        return changes

    def _new_row(self, row: int, cells: list[tuple[int, bytes]]) -> tuple[int, int, bytes]:
        """The XML of a row, which is formatted as the one above."""
        above = max((n for n in self._rows if n < row), default=None)
        tag = b"<%brow>" % self._prefix if above is None else self._start_tag(self._rows[above])
        for attribute in ("spans", "hidden", "collapsed", "outlineLevel"):
            tag = with_attribute(tag, attribute, None)
        xml = with_attribute(tag, "r", str(row)) + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix
        at = min((e.start for n, e in self._rows.items() if n > row), default=self._sheet_data.close)
        return at, at, xml


def _same(a: Cell, b: Cell) -> bool:
    return a == b and type(a.value) is type(b.value) and (a.style == b.style or a.origin is b.origin)


def _value(kind: str, parts: dict[str, Element], strings: list[str]) -> Any:
    if kind == "inlineStr" and "is" in parts:
        return _rich_text(parts["is"])
    if "v" not in parts:
        return None
    text = parts["v"].text
    if kind == "str":
        return text
    text = text.strip()
    if not text:
        return None
    try:
        if kind == "s":
            return strings[int(text)]
        if kind == "b":
            return bool(int(text))
        if kind == "n" and _NUMBER.fullmatch(text):
            return float(text)
    except (ValueError, IndexError):
        return Unreadable(text)
    return CellError(text) if kind == "e" else Unreadable(text)


def _rich_text(e: Element) -> str:
    """The text of a string's runs, without phonetic hints."""
    return e.text if e.name == "t" else "".join(_rich_text(run) for run in e.children if run.name in ("t", "r"))


def shared_strings(found: list[Element]) -> list[str]:
    """The texts in the elements of the part of shared strings."""
    return [_rich_text(e) for e in found if e.name == "si" and e.namespace == MAIN]


def moved(formula: str | None, start: At, to: At) -> str | None:
    """A formula as it reads when copied from `start` to `to`."""
    from openpyxl.formula.translate import Translator, TranslatorError

    if formula is None or start == to:
        return formula
    try:
        return str(Translator(formula, cell_name(start)).translate_formula(cell_name(to)))
    except TranslatorError:
        return "=#REF!"


def _stored(value: Any) -> tuple[str | None, str]:
    """The type of a value, as its cell's attribute, and its text."""
    if isinstance(value, bool):
        return "b", str(int(value))
    if isinstance(value, str):
        return "e" if isinstance(value, CellError) else "str", value
    return None, repr(value).removesuffix(".0")
