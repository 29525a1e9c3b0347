"""The cells of a worksheet's XML, which can be changed; writing replaces only the bytes of changed cells."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any

from ..errors import InputError
from .formulas import CellError
from .references import Reference, reference
from .xml_parts import Element, elements, escaped, spliced, utf8, with_attribute

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
STRICT = "http://purl.oclc.org/ooxml/spreadsheetml/main"

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

At = tuple[int, int]
"""Row and column, counted from 1."""


class Unreadable(str):
    """The text of a stored value that is neither number, text, boolean nor error."""


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
    """The content of a cell.

    Attributes
    ----------
    value : float, str, bool, CellError, Unreadable or None
        The typed value, or the stored result of the formula.
    formula : str or None
        With its "="; a shared formula as it reads in this cell.
    array : Reference or None
        The area of the array formula or data table that the cell belongs to, if that has several cells.
    single_array : bool
        Whether the formula is an array formula of this cell alone.
    """

    value: Any = None
    formula: str | None = None
    array: Reference | None = None
    single_array: bool = False
    origin: _Origin | None = field(default=None, compare=False, repr=False)

    @property
    def blank(self) -> bool:
        """Whether the cell is empty."""
        return self.value is None and self.formula is None and self.array is None

    @property
    def style(self) -> str | None:
        """The number of its style, None for the default."""
        return self.origin.element.attributes.get("s") if self.origin else None

    def typed(self, value: float | None) -> Cell:
        """The cell with a number, or nothing, instead of its content."""
        return replace(self, value=value, formula=None, single_array=False)


_BLANK = Cell()


class SheetXml:
    """The cells of a worksheet part.

    Parameters
    ----------
    data
        The part.
    strings
        The workbook's shared strings.
    name
        The sheet's name.
    file
        The workbook's name in messages.

    Attributes
    ----------
    cells : dict
        (row, column) -> `Cell`, to be changed before `to_bytes`.
    original : dict
        The cells as read.
    merged : list of Reference
        The merged areas.
    """

    def __init__(self, data: bytes, strings: list[str], name: str, file: str) -> None:
        self.name, self._file = name, file
        where = f"{file}: sheet {name}"
        self._data, self._to_encoding = utf8(data, where)
        self._rows: dict[int, Element] = {}
        self._in_row: dict[int, list[tuple[int, Element]]] = {}
        self._sheet_data: Element | None = None
        self._dimension: Element | None = None
        self.cells: dict[At, Cell] = {}
        self.merged: list[Reference] = []
        self._read(elements(self._data, where), strings)
        self.original = dict(self.cells)

    # Reading

    def _read(self, found: list[Element], strings: list[str]) -> None:
        inside: dict[int, list[Element]] = {}
        cells: list[tuple[At, Element]] = []
        row = column = 0
        for e in found:
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
                cells.append((at, e))
                self._in_row.setdefault(row, []).append((column, e))
            elif parent in ("c", "is", "r"):
                inside.setdefault(id(e.parent), []).append(e)
            elif e.name == "sheetData":
                self._sheet_data = e
            elif e.name == "dimension":
                self._dimension = e
            elif e.name == "mergeCell" and (area := reference(e.attributes.get("ref", ""))) is not None:
                self.merged.append(area)
        masters: dict[str, tuple[At, str]] = {}
        for at, element in cells:
            if at in self.cells:
                raise InputError(
                    f"{self._file}: {self.name}!{cell_name(at)} is stored twice in the file, expected it once; Excel or "
                    "LibreOffice may repair it"
                )
            self.cells[at] = self._cell(at, element, inside, strings, masters)
        self._mark_arrays()

    def _cell(
        self,
        at: At,
        element: Element,
        inside: dict[int, list[Element]],
        strings: list[str],
        masters: dict[str, tuple[At, str]],
    ) -> Cell:
        content = inside.get(id(element), [])
        parts = {e.name: e for e in content}
        if len(parts) < len(content):
            raise InputError(f"{self._file}: {self.name}!{cell_name(at)} has several values in the file, expected one")
        value = _value(element.attributes.get("t", "n"), parts, inside, strings)
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
        return Cell(value, text, origin=_Origin(at, element, formula, text, value, group))

    def _mark_arrays(self) -> None:
        for at, cell in list(self.cells.items()):
            f = cell.origin.formula if cell.origin else None
            if f is None or f.attributes.get("t") not in ("array", "dataTable"):
                continue
            area = reference(f.attributes.get("ref", ""))
            if area is None or (area.top, area.left) == (area.bottom, area.right):
                self.cells[at] = replace(cell, single_array=f.attributes["t"] == "array")
                continue
            for row in range(area.top, area.bottom + 1):
                for column in range(area.left, area.right + 1):
                    if (row, column) in self.cells:
                        self.cells[row, column] = replace(self.cells[row, column], array=area)
            self.cells[at] = replace(self.cells[at], array=area)

    @property
    def extent(self) -> At:
        """The last row and the last column with content."""
        filled = [at for at, cell in self.cells.items() if not cell.blank]
        return max((row for row, _ in filled), default=1), max((column for _, column in filled), default=1)

    # Changing

    def cell(self, at: At) -> Cell:
        """The cell, a blank one if the sheet has none there."""
        return self.cells.get(at, _BLANK)

    def type(self, at: At, value: float | None) -> None:
        """Put a number, or nothing, into a cell."""
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
            raise InputError(
                f"{self._file}: {self.name}!{cell_name(at)} is one cell of the array formula or data table "
                f"{_area_name(*area[1:])}, expected a cell of its own: its number cannot be changed alone"
            )

    @property
    def changed(self) -> list[At]:
        """The cells that are not as read, row by row."""
        return sorted(at for at, cell in self.cells.items() if not _same(cell, self.original.get(at, _BLANK)))

    @property
    def formulas_added_or_removed(self) -> bool:
        """Whether other cells have formulas than when read."""
        return any((self.cells[at].formula is None) != (self._was(at).formula is None) for at in self.changed)

    def _was(self, at: At) -> Cell:
        return self.original.get(at, _BLANK)

    # Writing

    def to_bytes(self) -> bytes:
        """The part with the changed cells."""
        changed = self.changed
        split = {group for at in changed if (group := self._group_without_text(at)) is not None}
        members = [at for at, cell in self.cells.items() if cell.origin and cell.origin.group in split]
        changes: list[tuple[int, int, bytes]] = []
        added: dict[int, list[tuple[int, bytes]]] = {}
        for at in sorted({*changed, *members}):
            xml, old = self._xml(at, split), self._was(at).origin
            if old is None:
                added.setdefault(at[0], []).append((at[1], xml))
            else:
                changes.append((old.element.start, old.element.end, xml))
        for row, cells in added.items():
            changes += self._into_row(self._rows[row], row, cells) if row in self._rows else [self._new_row(row, cells)]
        if added and self._dimension is not None:
            changes += self._grown(self._dimension)
        return self._to_encoding(spliced(self._data, changes))

    def _group_without_text(self, at: At) -> str | None:
        """The shared formula whose text the cell held and holds no longer."""
        was, cell = self._was(at), self.cells[at]
        if was.origin is None or was.origin.group is None or was.origin.formula is None:
            return None
        kept = cell.formula == was.formula and cell.origin is was.origin
        return None if kept or not was.origin.formula.text.strip() else was.origin.group

    def _xml(self, at: At, split: set[str]) -> bytes:
        """A cell's element; shared formulas of the groups in `split` become formulas of their own."""
        cell = self.cells[at]
        origin, data, prefix = cell.origin, self._data, self._prefix
        tag, value_kept = b"<%bc>" % prefix, False
        if origin is not None:
            tag = data[origin.element.start : origin.element.inner]
            tag = tag[:-2].rstrip() + b">" if tag.endswith(b"/>") else tag
            value_kept = cell.value is origin.value
        if origin is None or origin.at != at:
            tag = with_attribute(tag, "r", cell_name(at))
        if not value_kept or cell.value is None:
            tag = with_attribute(with_attribute(tag, "t", _type(cell.value)), "vm", None)
        if cell.formula is None:
            tag = with_attribute(tag, "cm", None)
        content = self._formula_xml(at, cell, split)
        if value_kept and origin is not None:
            inner, f = data[origin.element.inner : origin.element.close], origin.formula
            if f is not None:
                inner = inner[: f.start - origin.element.inner] + inner[f.end - origin.element.inner :]
            content += inner.strip()
        elif cell.value is not None:
            content += b"<%bv>%b</%bv>" % (prefix, escaped(_stored(cell.value)), prefix)
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

    def _into_row(self, element: Element, row: int, cells: list[tuple[int, bytes]]) -> list[tuple[int, int, bytes]]:
        tag = with_attribute(self._data[element.start : element.inner], "spans", None)
        if tag.endswith(b"/>"):
            whole = tag[:-2].rstrip() + b">" + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix
            return [(element.start, element.end, whole)]
        changes = [(element.start, element.inner, tag)]
        for column, xml in cells:
            at = min((e.start for c, e in self._in_row.get(row, []) if c > column), default=element.close)
            changes.append((at, at, xml))
        return changes

    def _new_row(self, row: int, cells: list[tuple[int, bytes]]) -> tuple[int, int, bytes]:
        """The XML of a row, which is formatted as the one above."""
        assert self._sheet_data is not None, "a sheet with cells has their element"
        tag = b"<%brow>" % self._prefix
        above = max((n for n in self._rows if n < row), default=None)
        if above is not None:
            tag = self._data[self._rows[above].start : self._rows[above].inner]
            tag = tag[:-2].rstrip() + b">" if tag.endswith(b"/>") else tag
        for attribute in ("spans", "hidden", "collapsed", "outlineLevel"):
            tag = with_attribute(tag, attribute, None)
        xml = with_attribute(tag, "r", str(row)) + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix
        at = min((e.start for n, e in self._rows.items() if n > row), default=self._sheet_data.close)
        return at, at, xml

    def _grown(self, e: Element) -> list[tuple[int, int, bytes]]:
        """The stated size of the sheet, made to hold its new cells."""
        area = reference(e.attributes.get("ref", ""))
        if area is None:
            return []
        rows, columns = zip(*(at for at in self.cells if at not in self.original), strict=True)
        top, bottom = min(area.top, *rows), max(area.bottom, *rows)
        left, right = min(area.left, *columns), max(area.right, *columns)
        tag = with_attribute(self._data[e.start : e.inner], "ref", _area_name(top, left, bottom, right))
        return [(e.start, e.inner, tag)]

    @property
    def _prefix(self) -> bytes:
        assert self._sheet_data is not None, "a sheet with cells has their element"
        return self._data[self._sheet_data.start + 1 : self._sheet_data.inner].split(b"sheetData", 1)[0]


def _same(a: Cell, b: Cell) -> bool:
    return a == b and type(a.value) is type(b.value) and (a.style == b.style or a.origin is b.origin)


def _value(kind: str, parts: dict[str, Element], inside: dict[int, list[Element]], strings: list[str]) -> Any:
    if kind == "inlineStr" and "is" in parts:
        return _rich_text(parts["is"], inside)
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


def _rich_text(element: Element, inside: dict[int, list[Element]]) -> str:
    runs = inside.get(id(element), [])
    return "".join(e.text if e.name == "t" else _rich_text(e, inside) for e in runs if e.name in ("t", "r"))


def shared_strings(data: bytes, name: str) -> list[str]:
    """The texts of the part of shared strings, without phonetic hints."""
    strings: list[str] = []
    for e in elements(utf8(data, name)[0], name):
        if e.namespace != MAIN:
            continue
        if e.name == "si":
            strings.append("")
        elif e.name == "t" and strings and e.parent is not None and e.parent.name in ("si", "r"):
            strings[-1] += e.text
    return strings


def moved(formula: str | None, start: At, to: At) -> str | None:
    """A formula as it reads when copied from `start` to `to`."""
    from openpyxl.formula.translate import Translator, TranslatorError

    if formula is None or start == to:
        return formula
    try:
        return str(Translator(formula, cell_name(start)).translate_formula(cell_name(to)))
    except TranslatorError:
        return "=#REF!"


def cell_name(at: At) -> str:
    """E.g. ``B3``."""
    from openpyxl.utils import get_column_letter

    return f"{get_column_letter(at[1])}{at[0]}"


def _area_name(top: int, left: int, bottom: int, right: int) -> str:
    return f"{cell_name((top, left))}:{cell_name((bottom, right))}"


def _type(value: Any) -> str | None:
    if isinstance(value, bool):
        return "b"
    if isinstance(value, CellError):
        return "e"
    return "str" if isinstance(value, str) else None


def _stored(value: Any) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)
