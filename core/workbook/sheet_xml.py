"""A worksheet's XML as cells that can be changed, and back with only the changed cells' bytes replaced."""

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
    """A stored value of a kind that formulas are not computed with here; its text."""


@dataclass(frozen=True)
class _Origin:
    """The XML a cell was read from."""

    at: At
    element: Element
    formula: Element | None
    text: str | None
    value: Any
    style: str | None
    group: str | None


@dataclass(frozen=True)
class Cell:
    """What is in a cell.

    Attributes
    ----------
    value : float, str, bool, CellError or None
        Typed in, or the stored result of the formula.
    formula : str or None
        With its "="; a shared formula as it reads in this cell.
    array : Reference or None
        The cells of the array formula or data table that this one is of, if they are more than this one.
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
        """Whether there is nothing in it."""
        return self.value is None and self.formula is None and self.array is None

    @property
    def style(self) -> str | None:
        """The number of its style, None for the workbook's own."""
        return self.origin.style if self.origin else None

    def typed(self, value: float | None) -> Cell:
        """With a number, or nothing, in place of what it holds."""
        return replace(self, value=value, formula=None, single_array=False)


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
        How messages call the workbook.

    Attributes
    ----------
    cells : dict
        (row, column) -> `Cell`; change it as you like, then ask for `to_bytes`.
    original : dict
        The cells as they were read.
    merged : list of Reference
        Cells that are shown as one.
    """

    def __init__(self, data: bytes, strings: list[str], name: str, file: str) -> None:
        self.name, self._file = name, file
        where = f"{file}: sheet {name}"
        self._data, self._back = utf8(data, where)
        self._rows: list[tuple[int, Element]] = []
        self._in_row: dict[int, list[tuple[int, Element]]] = {}
        self.cells: dict[At, Cell] = {}
        self.merged: list[Reference] = []
        self._read(elements(self._data, where), strings)
        self.original = dict(self.cells)

    # Reading

    def _read(self, found: list[Element], strings: list[str]) -> None:
        inside: dict[int, list[Element]] = {}
        cells: list[tuple[At, Element]] = []
        self._sheet_data: Element | None = None
        self._dimension: Element | None = None
        row = column = 0
        for e in found:
            parent = e.parent.name if e.parent is not None else ""
            if e.namespace != MAIN:
                continue
            if e.name == "row" and parent == "sheetData":
                row = int(e.attributes.get("r", row + 1))
                column = 0
                self._rows.append((row, e))
            elif e.name == "c" and parent == "row":
                named = reference(e.attributes["r"]) if "r" in e.attributes else None
                # A cell's own name counts, whatever row it is in, as in spreadsheet programs.
                place = (named.top, named.left) if named else (row, column + 1)
                column = place[1]
                cells.append((place, e))
                self._in_row.setdefault(row, []).append((column, e))
            elif parent in ("c", "is", "r") and e.parent is not None:
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
                    f"{self._file}: {self.name}!{_name(at)} is stored twice in the file, expected it once; Excel or "
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
        parts = {e.name: e for e in inside.get(id(element), [])}
        if len(parts) < len(inside.get(id(element), [])):
            raise InputError(f"{self._file}: {self.name}!{_name(at)} has several values in the file, expected one")
        value = _value(element.attributes.get("t", "n"), parts, inside, strings)
        formula, group, text = parts.get("f"), None, None
        if formula is not None:
            text = formula.text.strip() or None
            if formula.attributes.get("t") == "shared":
                group = formula.attributes.get("si", "")
                if text is not None:
                    masters[group] = at, text
                elif group in masters:
                    text = _translated(masters[group][1], masters[group][0], at)
            if text is not None:
                text = f"={text}"
        origin = _Origin(at, element, formula, text, value, element.attributes.get("s"), group)
        return Cell(value, text, origin=origin)

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
                    member = self.cells.get((row, column))
                    if member is not None:
                        self.cells[row, column] = replace(member, array=area)
            self.cells[at] = replace(self.cells[at], array=area)

    @property
    def extent(self) -> At:
        """The last row and the last column with content."""
        filled = [at for at, cell in self.cells.items() if not cell.blank]
        return max((row for row, _ in filled), default=1), max((column for _, column in filled), default=1)

    # Changing

    def cell(self, at: At) -> Cell:
        """The cell, a new one where there is none."""
        return self.cells.get(at, _NEW)

    def type(self, at: At, value: float | None) -> None:
        """Put a number, or nothing, into a cell."""
        self.refuse_array(at)
        self.cells[at] = self.cell(at).typed(value)

    def copy_row(self, cell: Cell, start: At, to: At) -> None:
        """Put `cell`, which stood at `start`, at `to`: relative references of its formula move along."""
        self.cells[to] = replace(cell, formula=_moved(cell.formula, start, to))

    def formula_at(self, start: At, to: At) -> str | None:
        """The formula of the cell at `start` as it would read at `to`."""
        return _moved(self.cell(start).formula, start, to)

    def refuse_array(self, at: At) -> None:
        """Raise `InputError` where a cell is one of several of an array formula: these change only together."""
        area = self.cell(at).array
        if area is not None:
            first, last = _name((area.top, area.left)), _name((area.bottom, area.right))
            raise InputError(
                f"{self._file}: {self.name}!{_name(at)} is one cell of the array formula or data table {first}:{last}, "
                "expected a cell of its own: its number cannot be changed alone"
            )

    @property
    def changed(self) -> list[At]:
        """The cells that are not as they were read, row by row."""
        return sorted(at for at, cell in self.cells.items() if not _same(cell, self.original.get(at, _NEW)))

    @property
    def formulas_moved(self) -> bool:
        """Whether a cell that held a formula holds none now, or the other way round."""
        return any(
            (cell.formula is None) != (self.original.get(at, _NEW).formula is None) for at, cell in self.cells.items()
        )

    # Writing

    def to_bytes(self) -> bytes:
        """The part with the changed cells."""
        changed = {at: self._xml(at, self.cells[at]) for at in self.changed}
        changed.update(self._handed_on())
        old = {at: self.original[at].origin for at in changed if at in self.original}
        changes = [(o.element.start, o.element.end, changed[at]) for at, o in old.items() if o is not None]
        added: dict[int, list[tuple[int, bytes]]] = {}
        for (row, column), xml in sorted(changed.items()):
            if (row, column) not in old:
                added.setdefault(row, []).append((column, xml))
        elements_of = dict(self._rows)
        for row, cells in added.items():
            element = elements_of.get(row)
            changes += self._new_row(row, cells) if element is None else self._into_row(row, element, cells)
        return self._back(spliced(self._data, self._grown(changes, list(added))))

    def _xml(self, at: At, cell: Cell, shared: str | None = None) -> bytes:
        """A cell's element; `shared`, the cells of the shared formula that it is made the first of."""
        origin, data = cell.origin, self._data
        prefix = self._prefix
        if origin is None:
            tag = b"<%bc>" % prefix
            same_value = False
        else:
            element = origin.element
            tag = data[element.start : element.inner]
            tag = tag[:-2].rstrip() + b">" if tag.endswith(b"/>") else tag
            same_value = cell.value is origin.value
        if origin is None or origin.at != at:
            tag = with_attribute(tag, "r", _name(at))
        if not same_value or cell.value is None:
            tag = with_attribute(with_attribute(tag, "t", _type(cell.value)), "vm", None)
        if cell.formula is None:
            tag = with_attribute(tag, "cm", None)
        content = self._formula_xml(at, cell, shared)
        if same_value and origin is not None:
            f = origin.formula
            inner = data[origin.element.inner : origin.element.close]
            if f is not None:
                skip = f.start - origin.element.inner
                inner = inner[:skip] + inner[skip + f.end - f.start :]
            content += inner.strip()
        elif cell.value is not None:
            content += b"<%bv>%b</%bv>" % (prefix, escaped(_stored(cell.value)), prefix)
        if not content:
            return tag[:-1] + b"/>"
        return tag + content + b"</%bc>" % prefix

    def _formula_xml(self, at: At, cell: Cell, shared: str | None) -> bytes:
        origin = cell.origin
        kept = origin is not None and origin.formula is not None and origin.text == cell.formula
        if kept and origin is not None and origin.formula is not None and shared is None:
            plain = origin.formula.attributes.get("t", "normal") == "normal"
            if plain or origin.at == at:
                return self._data[origin.formula.start : origin.formula.end]
        if cell.formula is None:
            return b""
        attributes = b""
        if shared is not None and origin is not None:
            attributes = b' t="shared" ref="%b" si="%b"' % (shared.encode(), escaped(origin.group or ""))
        elif cell.single_array:
            attributes = b' t="array" ref="%b"' % _name(at).encode()
        text = cell.formula[1:]
        if text != text.strip():
            attributes += b' xml:space="preserve"'
        return b"<%bf%b>%b</%bf>" % (self._prefix, attributes, escaped(text), self._prefix)

    def _handed_on(self) -> dict[At, bytes]:
        """The first cell left of each shared formula whose first cell holds it no more, with the formula."""
        left: dict[str, list[At]] = {}
        lost: set[str] = set()
        for at, was in self.original.items():
            group = was.origin.group if was.origin else None
            if group is None or was.formula is None:
                continue
            cell = self.cells[at]
            if cell.formula == was.formula and cell.origin is was.origin:
                left.setdefault(group, []).append(at)
            elif was.origin is not None and was.origin.formula is not None and was.origin.formula.text.strip():
                lost.add(group)
        handed = {}
        for group in lost & set(left):
            rows, columns = zip(*left[group], strict=True)
            area = f"{_name((min(rows), min(columns)))}:{_name((max(rows), max(columns)))}"
            first = min(left[group], key=lambda at: self._place(at))
            handed[first] = self._xml(first, self.cells[first], area)
        return handed

    def _place(self, at: At) -> int:
        origin = self.original[at].origin
        return origin.element.start if origin is not None else 0

    def _into_row(self, row: int, element: Element, cells: list[tuple[int, bytes]]) -> list[tuple[int, int, bytes]]:
        tag = self._data[element.start : element.inner]
        spans = [int(x) for x in element.attributes.get("spans", "").replace(":", " ").split() if x.isdigit()]
        new_tag = tag
        if spans and not all(min(spans) <= column <= max(spans) for column, _ in cells):
            new_tag = with_attribute(tag, "spans", None)
        if element.close == element.inner == element.end and tag.endswith(b"/>"):
            inner = b"".join(xml for _, xml in cells)
            whole = new_tag[:-2].rstrip() + b">" + inner + b"</%brow>" % self._prefix
            return [(element.start, element.end, whole)]
        changes = [(element.start, element.inner, new_tag)] if new_tag != tag else []
        for column, xml in cells:
            after = [e.start for c, e in self._in_row.get(row, []) if c > column]
            at = min(after, default=element.close)
            changes.append((at, at, xml))
        return changes

    def _new_row(self, row: int, cells: list[tuple[int, bytes]]) -> list[tuple[int, int, bytes]]:
        assert self._sheet_data is not None, "a sheet with cells has their element"
        above = [(n, e) for n, e in self._rows if n < row]
        tag = b"<%brow>" % self._prefix
        if above:
            model = max(above, key=lambda pair: pair[0])[1]
            tag = self._data[model.start : model.inner]
            tag = tag[:-2].rstrip() + b">" if tag.endswith(b"/>") else tag
        for attribute in ("spans", "hidden", "collapsed", "outlineLevel"):
            tag = with_attribute(tag, attribute, None)
        tag = with_attribute(tag, "r", str(row))
        xml = tag + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix
        below = [e.start for n, e in self._rows if n > row]
        at = min(below, default=self._sheet_data.close)
        return [(at, at, xml)]

    def _grown(self, changes: list[tuple[int, int, bytes]], rows: list[int]) -> list[tuple[int, int, bytes]]:
        """The changes, and one to the stated size of the sheet where cells were added beyond it."""
        e = self._dimension
        area = reference(e.attributes.get("ref", "")) if e is not None else None
        if e is None or area is None or not rows:
            return changes
        added = [at for at in self.cells if at not in self.original]
        top, bottom = min(area.top, *(r for r, _ in added)), max(area.bottom, *(r for r, _ in added))
        left, right = min(area.left, *(c for _, c in added)), max(area.right, *(c for _, c in added))
        if (top, left, bottom, right) == area[1:]:
            return changes
        name = f"{_name((top, left))}:{_name((bottom, right))}"
        return [*changes, (e.start, e.inner, with_attribute(self._data[e.start : e.inner], "ref", name))]

    @property
    def _prefix(self) -> bytes:
        assert self._sheet_data is not None, "a sheet with cells has their element"
        tag = self._data[self._sheet_data.start + 1 : self._sheet_data.inner].split(b"sheetData", 1)[0]
        return tag


_NEW = Cell()


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
    texts = [e.text if e.name == "t" else _rich_text(e, inside) for e in runs if e.name in ("t", "r")]
    return "".join(texts)


def shared_strings(data: bytes, name: str) -> list[str]:
    """The texts of the part of shared strings, phonetic hints left out."""
    strings: list[str] = []
    for e in elements(utf8(data, name)[0], name):
        if e.namespace != MAIN:
            continue
        if e.name == "si":
            strings.append("")
        elif e.name == "t" and strings and e.parent is not None and e.parent.name in ("si", "r"):
            strings[-1] += e.text
    return strings


def _moved(formula: str | None, start: At, to: At) -> str | None:
    return formula and "=" + _translated(formula[1:], start, to)


def _translated(formula: str, start: At, to: At) -> str:
    from openpyxl.formula.translate import Translator, TranslatorError

    if start == to:
        return formula
    try:
        return Translator(f"={formula}", origin=_name(start)).translate_formula(_name(to))[1:]
    except TranslatorError:
        return "#REF!"


def _name(at: At) -> str:
    from openpyxl.utils import get_column_letter

    return f"{get_column_letter(at[1])}{at[0]}"


def _type(value: Any) -> str | None:
    if isinstance(value, bool):
        return "b"
    if isinstance(value, CellError):
        return "e"
    return "str" if isinstance(value, str) else None


def _stored(value: Any) -> str:
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return repr(value).removesuffix(".0")
    return str(value)
