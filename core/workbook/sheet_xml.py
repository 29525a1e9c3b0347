"""Cells of a worksheet's XML part, read and changed; writing replaces only the bytes of changed cells."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

from ..errors import InputError
from .package import Element, escape_xml, parse_elements, set_attribute, splice

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
STRICT = "http://purl.oclc.org/ooxml/spreadsheetml/main"

MAX_ROW, MAX_COLUMN = 1_048_576, 16_384
Position = tuple[int, int]
"""Row and column of a cell, counted from 1."""

_ESCAPE = re.compile("_x([0-9A-Fa-f]{4})_")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

_SHEET = re.compile(r"'((?:[^'\[\]]|'')+)'|[^'!\[\]()\s]+")
"""Name of a sheet in a formula; a sheet of another file has brackets, which do not match."""


class CellError(str):
    """Error value of a cell, such as #REF! or #DIV/0!."""


class UnreadableValue(str):
    """Text of a stored value that is neither number, text, boolean nor error."""


class Reference(NamedTuple):
    """Area of cells that a formula refers to."""

    sheet: str | None
    """Name of the sheet; None for the formula's own sheet, "First:Last" for an area through several sheets."""
    top: int
    left: int
    bottom: int
    right: int

    @property
    def name(self) -> str:
        """Name of the area without its sheet, such as ``B3:C5``."""
        return f"{cell_name((self.top, self.left))}:{cell_name((self.bottom, self.right))}"

    @property
    def size(self) -> int:
        """Number of cells in the area."""
        return (self.bottom - self.top + 1) * (self.right - self.left + 1)

    def contains(self, row: int, column: int) -> bool:
        """Return whether a cell lies in the area; the sheet is not compared."""
        return self.top <= row <= self.bottom and self.left <= column <= self.right


def cell_name(position: Position) -> str:
    """Return the name of the cell at (row, column), such as ``B3``."""
    from openpyxl.utils import get_column_letter

    return f"{get_column_letter(position[1])}{position[0]}"


@lru_cache(maxsize=2**15)
def parse_reference(text: str) -> Reference | None:
    """Return the area of a reference such as ``B3``, ``'My sheet'!$B$3:$B$82``, ``A:C`` or ``3:5``.

    Returns None for a defined name and for a cell of another file.
    """
    from openpyxl.utils import range_boundaries

    sheet_text, separator, cells = text.rpartition("!")
    sheet_match = _SHEET.fullmatch(sheet_text)
    try:
        left, top, right, bottom = range_boundaries(cells)
    except ValueError:
        return None
    if (separator and sheet_match is None) or (":" not in cells and None in (left, top)):
        return None
    sheet = sheet_match[1].replace("''", "'") if sheet_match and sheet_match[1] else sheet_text or None
    columns = sorted([left or 1, right or MAX_COLUMN])
    rows = sorted([1 if top is None else top, MAX_ROW if bottom is None else bottom])
    if rows[0] < 1 or rows[1] > MAX_ROW or columns[1] > MAX_COLUMN:
        return None
    return Reference(sheet, rows[0], columns[0], rows[1], columns[1])


@dataclass(frozen=True)
class _CellOrigin:
    """Cell as it was read from the file, with the XML that is kept where it does not change."""

    position: Position
    element: Element
    """The cell's element."""
    formula: Element | None
    """Element of the formula inside the cell's element."""
    text: str | None
    """Formula with its "=", or None; a shared formula is translated to this cell."""
    value: Any
    shared_index: str | None
    """Index of the shared formula that the cell belongs to, None for any other cell."""


@dataclass(frozen=True)
class Cell:
    """Content of a cell."""

    value: Any = None
    """The typed value, or the stored result of the formula: a float, str, bool, `CellError`, `UnreadableValue` or None."""
    formula: str | None = None
    """Formula with its "="; a shared formula is translated to this cell."""
    array: Reference | None = None
    """Area of the array formula or data table that the cell belongs to, if that covers several cells."""
    is_single_array: bool = False
    """Whether the formula is an array formula of this cell alone."""
    origin: _CellOrigin | None = field(default=None, compare=False, repr=False)
    """The cell in the file that this content comes from, None for a new cell."""

    @property
    def blank(self) -> bool:
        """Whether the cell is empty."""
        return self.value is None and self.formula is None and self.array is None

    @property
    def style(self) -> str | None:
        """Number of the cell's style, None for the default style."""
        return self.origin.element.attributes.get("s") if self.origin else None

    def with_value(self, value: float | str | None) -> Cell:
        """Return the cell with a number, a text or nothing in place of its content."""
        return replace(self, value=None if value == "" else value, formula=None, is_single_array=False)


_BLANK = Cell()


class SheetXml:
    """Cells of a worksheet part, to be changed and written back.

    `data` is the XML, `strings` are the workbook's shared strings; messages name the `file` and the sheet's `name`.
    """

    def __init__(self, data: bytes, strings: list[str], name: str, file: str) -> None:
        self.name, self._file, self._data = name, file, data
        self._rows: dict[int, Element] = {}
        self._cells_in_row: dict[int, list[tuple[int, Element]]] = defaultdict(list)
        self._sheet_data: Element  # every sheet with cells has one
        self._prefix = b""
        self._dimension: Element | None = None
        self.cells: dict[Position, Cell] = {}
        """Position -> content of the cell, changed or not."""
        self.merged_areas: list[Reference] = []
        self._shared_formulas: dict[str, tuple[Position, str]] = {}
        """Index of a shared formula -> position of the cell that holds its text, and the text."""
        row = column = 0
        for e in parse_elements(data, f"{file}: sheet {name}"):
            if e.namespace != MAIN:
                continue
            parent = e.parent.name if e.parent is not None else ""
            if e.name == "row" and parent == "sheetData":
                row, column = int(e.attributes.get("r", row + 1)), 0
                self._rows.setdefault(row, e)
            elif e.name == "c" and parent == "row":
                address = parse_reference(e.attributes["r"]) if "r" in e.attributes else None
                # As in spreadsheet programs, a cell's address decides, whatever row element it is in.
                position = (address.top, address.left) if address else (row, column + 1)
                column = position[1]
                self._cells_in_row[row].append((column, e))
                self._read_cell(position, e, strings)
            elif e.name == "sheetData":
                self._sheet_data = e
                self._prefix = data[e.start + 1 : e.inner].split(b"sheetData", 1)[0]
            elif e.name == "dimension":
                self._dimension = e
            elif e.name == "mergeCell" and (area := parse_reference(e.attributes.get("ref", ""))) is not None:
                self.merged_areas.append(area)
        self._mark_arrays()
        self.original = dict(self.cells)
        """Position -> content of the cell in the file."""

    def _read_cell(self, position: Position, element: Element, strings: list[str]) -> None:
        """Add the cell at a position from its element; `strings` are the workbook's shared strings."""
        children = {e.name: e for e in element.children if e.namespace == MAIN}
        if position in self.cells:
            problem = f"{self.name}!{cell_name(position)} is stored twice in the file"
            raise InputError(f"{self._file}: {problem}, expected it once; Excel or LibreOffice may repair it")
        if len(children) < sum(e.namespace == MAIN for e in element.children):
            raise InputError(f"{self._file}: {self.name}!{cell_name(position)} stores several values, expected one")
        value = _read_value(element.attributes.get("t", "n"), children, strings)
        formula, shared_index, text = children.get("f"), None, None
        if formula is not None:
            text = f"={formula.text.strip()}" if formula.text.strip() else None
            if formula.attributes.get("t") == "shared":
                shared_index = formula.attributes.get("si", "")
                if text is not None:
                    self._shared_formulas[shared_index] = position, text
                elif shared_index in self._shared_formulas:
                    start, text = self._shared_formulas[shared_index]
                    text = translate_formula(text, start, position)
        origin = _CellOrigin(position, element, formula, text, value, shared_index)
        self.cells[position] = Cell(value, text, origin=origin)

    def _mark_arrays(self) -> None:
        """Set `array` or `is_single_array` of the cells that belong to array formulas and data tables."""
        for position, cell in list(self.cells.items()):
            formula = cell.origin.formula if cell.origin else None
            if formula is None or formula.attributes.get("t") not in ("array", "dataTable"):
                continue
            area = parse_reference(formula.attributes.get("ref", ""))
            if area is None or (area.top, area.left) == (area.bottom, area.right):
                self.cells[position] = replace(cell, is_single_array=formula.attributes["t"] == "array")
                continue
            for member in self.cells:
                if member == position or area.contains(*member):
                    self.cells[member] = replace(self.cells[member], array=area)

    def cell(self, position: Position) -> Cell:
        """Return the cell at a position, a blank one if the sheet has none there."""
        return self.cells.get(position, _BLANK)

    def set_value(self, position: Position, value: float | str | None) -> None:
        """Put a number or a text into a cell, or nothing, in place of its content."""
        self.refuse_array(position)
        self.cells[position] = self.cell(position).with_value(value)

    def copy_cell(self, cell: Cell, start: Position, target: Position) -> None:
        """Put `cell`, which stood at `start`, at `target`; the relative references of its formula move along."""
        self.refuse_array(start)
        self.refuse_array(target)
        self.cells[target] = replace(cell, formula=translate_formula(cell.formula, start, target))

    def refuse_array(self, position: Position) -> None:
        """Raise `InputError` for a cell of an array formula of several cells: these change only together."""
        if (area := self.cell(position).array) is not None:
            problem = f"{self.name}!{cell_name(position)} is one cell of the array formula or data table {area.name}"
            raise InputError(f"{self._file}: {problem}, expected a cell of its own: its number cannot be changed alone")

    @property
    def changed_positions(self) -> list[Position]:
        """Positions of the cells that differ from the file, row by row."""
        return sorted(p for p, cell in self.cells.items() if not _is_unchanged(cell, self._original(p)))

    @property
    def formulas_added_or_removed(self) -> bool:
        """Whether a cell has a formula now and none in the file, or the reverse."""
        pairs = ((self.cells[p].formula, self._original(p).formula) for p in self.changed_positions)
        return any((formula is None) != (original is None) for formula, original in pairs)

    def _original(self, position: Position) -> Cell:
        """Return the content of a cell in the file, a blank one if the file has none there."""
        return self.original.get(position, _BLANK)

    def to_bytes(self) -> bytes:
        """Return the XML of the worksheet with the changed cells."""
        changed = self.changed_positions
        # The cells of a shared formula need formulas of their own when the cell that holds its text changes.
        split = {index for position in changed if (index := self._lost_shared_index(position)) is not None}
        members = [p for p, cell in self.cells.items() if cell.origin and cell.origin.shared_index in split]
        changes: list[tuple[int, int, bytes]] = []
        added: dict[int, list[tuple[int, bytes]]] = defaultdict(list)
        for position in sorted({*changed, *members}):
            xml, origin = self._cell_xml(position, split), self._original(position).origin
            if origin is None:
                added[position[0]].append((position[1], xml))
            else:
                changes.append((origin.element.start, origin.element.end, xml))
        for row, cells in added.items():
            changes += self._fill_row(self._rows[row], row, cells) if row in self._rows else [self._new_row(row, cells)]
        area = None if self._dimension is None else parse_reference(self._dimension.attributes.get("ref", ""))
        if added and self._dimension is not None and area is not None:
            e, columns = self._dimension, [column for cells in added.values() for column, _ in cells]
            top, left = min(area.top, *added), min(area.left, *columns)
            enlarged = Reference(None, top, left, max(area.bottom, *added), max(area.right, *columns))
            changes.append((e.start, e.inner, set_attribute(self._data[e.start : e.inner], "ref", enlarged.name)))
        return splice(self._data, changes)

    def _lost_shared_index(self, position: Position) -> str | None:
        """Return the index of the shared formula whose text the cell held in the file and holds no longer, else None."""
        original, cell = self._original(position), self.cells[position]
        if (origin := original.origin) is None or origin.formula is None or not origin.formula.text.strip():
            return None
        return None if cell.formula == original.formula and cell.origin is origin else origin.shared_index

    def _cell_xml(self, position: Position, split: set[str]) -> bytes:
        """Return the XML of a cell; shared formulas with an index in `split` are written out as formulas of the cell."""
        cell = self.cells[position]
        origin, data, prefix = cell.origin, self._data, self._prefix
        tag = b"<%bc>" % prefix if origin is None else self._start_tag(origin.element)
        value_unchanged = origin is not None and cell.value is origin.value
        if origin is None or origin.position != position:
            tag = set_attribute(tag, "r", cell_name(position))
        if not value_unchanged or cell.value is None:
            tag = set_attribute(set_attribute(tag, "t", _type_and_text(cell.value)[0]), "vm", None)
        if cell.formula is None:
            tag = set_attribute(tag, "cm", None)
        content = self._formula_xml(position, cell, split)
        if value_unchanged and origin is not None:
            inner, formula = data[origin.element.inner : origin.element.close], origin.formula
            if formula is not None:
                inner = inner[: formula.start - origin.element.inner] + inner[formula.end - origin.element.inner :]
            content += inner.strip()
        elif cell.value is not None:
            content += b"<%bv>%b</%bv>" % (prefix, escape_xml(_type_and_text(cell.value)[1]), prefix)
        return tag + content + b"</%bc>" % prefix if content else tag[:-1] + b"/>"

    def _formula_xml(self, position: Position, cell: Cell, split: set[str]) -> bytes:
        """Return the XML of a cell's formula, byte by byte that of the file where it is unchanged."""
        origin = cell.origin
        if origin is not None and origin.formula is not None and origin.text == cell.formula:
            is_normal = origin.formula.attributes.get("t", "normal") == "normal"
            if is_normal or (origin.position == position and origin.shared_index not in split):
                return self._data[origin.formula.start : origin.formula.end]
        if cell.formula is None:
            return b""
        attributes = b' t="array" ref="%b"' % cell_name(position).encode() if cell.is_single_array else b""
        if (text := cell.formula[1:]) != text.strip():
            attributes += b' xml:space="preserve"'
        return b"<%bf%b>%b</%bf>" % (self._prefix, attributes, escape_xml(text), self._prefix)

    def _start_tag(self, element: Element) -> bytes:
        """Return the start tag of an element; that of an empty element is opened: "<row/>" gives "<row>"."""
        tag = self._data[element.start : element.inner]
        return tag[:-2].rstrip() + b">" if tag.endswith(b"/>") else tag

    def _fill_row(self, element: Element, row: int, cells: list[tuple[int, bytes]]) -> list[tuple[int, int, bytes]]:
        """Return the changes, for `splice`, that insert cells, (column, XML), into a row that the sheet has."""
        tag = set_attribute(self._start_tag(element), "spans", None)
        if element.inner == element.end:
            return [(element.start, element.end, tag + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix)]
        changes = [(element.start, element.inner, tag)]
        for column, xml in cells:
            offset = min((e.start for c, e in self._cells_in_row[row] if c > column), default=element.close)
            changes.append((offset, offset, xml))
        return changes

    def _new_row(self, row: int, cells: list[tuple[int, bytes]]) -> tuple[int, int, bytes]:
        """Return the change, for `splice`, that inserts a row with these cells, formatted as the row above."""
        above = max((number for number in self._rows if number < row), default=None)
        tag = b"<%brow>" % self._prefix if above is None else self._start_tag(self._rows[above])
        for attribute in ("spans", "hidden", "collapsed", "outlineLevel"):
            tag = set_attribute(tag, attribute, None)
        xml = set_attribute(tag, "r", str(row)) + b"".join(xml for _, xml in cells) + b"</%brow>" % self._prefix
        offset = min((e.start for n, e in self._rows.items() if n > row), default=self._sheet_data.close)
        return offset, offset, xml


def _is_unchanged(cell: Cell, original: Cell) -> bool:
    """Return whether a cell has the content, the type of value and the style of the original."""
    is_styled_alike = cell.style == original.style or cell.origin is original.origin
    return cell == original and type(cell.value) is type(original.value) and is_styled_alike


def _read_value(cell_type: str, children: dict[str, Element], strings: list[str]) -> Any:
    """Return the stored value of a cell from its attribute "t" and its child elements, None if it stores nothing."""
    if cell_type == "inlineStr" and "is" in children:
        return _rich_text(children["is"])
    if "v" not in children:
        return None
    text = children["v"].text
    if cell_type == "str":
        return unescaped(text)
    if not (text := text.strip()):
        return None
    try:
        if cell_type == "s":
            return strings[int(text)]
        if cell_type == "b":
            return bool(int(text))
        if cell_type == "n" and _NUMBER.fullmatch(text):
            return float(text)
    except (ValueError, IndexError):
        return UnreadableValue(text)
    return CellError(text) if cell_type == "e" else UnreadableValue(text)


def _rich_text(element: Element) -> str:
    """Return the text of a string's runs, without phonetic hints."""
    runs = (run for run in element.children if run.name in ("t", "r"))
    return unescaped(element.text) if element.name == "t" else "".join(map(_rich_text, runs))


def unescaped(text: str) -> str:
    """Return a stored text with its characters for ``_xHHHH_`` (ECMA-376 part 1, 22.9.2.19), as a pasted line break has."""
    return _ESCAPE.sub(lambda match: chr(int(match[1], 16)), text)


def shared_strings(elements: list[Element]) -> list[str]:
    """Return the texts of the workbook's shared strings, from all elements of their part."""
    return [_rich_text(e) for e in elements if e.name == "si" and e.namespace == MAIN]


def translate_formula(formula: str | None, start: Position, target: Position) -> str | None:
    """Return the formula of the cell `start` as a spreadsheet writes it when the cell is copied to `target`."""
    from openpyxl.formula.translate import Translator, TranslatorError

    if formula is None or start == target:
        return formula
    try:
        return str(Translator(formula, cell_name(start)).translate_formula(cell_name(target)))
    except TranslatorError:
        return "=#REF!"


def _type_and_text(value: Any) -> tuple[str | None, str]:
    """Return the attribute "t" of a cell that stores `value`, and the text of the value in the XML."""
    if isinstance(value, bool):
        return "b", str(int(value))
    if isinstance(value, str):
        return "e" if isinstance(value, CellError) else "str", _ESCAPE.sub(r"_x005F\g<0>", value)
    return None, repr(value).removesuffix(".0")
