"""Writer of a scanner into a new workbook, or a new sheet of a workbook; its formulas store the scanner's values."""

import io
import math
import re
import zipfile
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from ..errors import InputError
from ..geometry.columns import Column
from ..geometry.scanner import Scanner, first_true
from .layout import MAX_MODULES
from .sheet_xml import CellError, cell_name

_PARTS = Path(__file__).with_name("new_workbook.txt")
"""File with the XML of a new workbook: its parts one after another, each below its name; the last part is a sheet."""
_RELATION = (
    '<Relationship Id="rId{}" Type="http://schemas.openxmlformats.org/officeDocument/2006/relationships/worksheet" '
    'Target="worksheets/{}.xml"/>'
)
_NORMAL, _HEADING, _FOUR_DECIMALS = range(3)
"""Numbers of the styles of cells in a new workbook."""
_FIRST_ROW = 3
"""Row of the first module."""
_LARGEST_NUMBER = 2**53 - 1
"""Largest module number that a cell holds exactly."""
_INFINITE = math.inf, -math.inf
_Content = list[tuple[Any, str]]
"""(value, formula) of each module's cell in a column; the formula is "" where a number is typed."""


def new_workbook(system: Scanner) -> tuple[bytes, dict[str, Any]]:
    """Return a workbook in the layout of the scanner's kind, and the values that its formulas store: address -> value."""
    sheets, stored = new_sheets(system)
    files = [re.sub(r"[^\w-]", "_", title, flags=re.ASCII) for title in sheets]
    parts = dict(part.split("\n", 1) for part in _PARTS.read_text(encoding="ascii").split("--- ")[1:])
    path, sheet = parts.popitem()
    for i, (file, rows) in enumerate(zip(files, sheets.values(), strict=True)):
        selected = "" if i else ' tabSelected="1"'
        parts[path.format(file=file)] = sheet.format(selected=selected, rows="".join(rows.values()))
    entries = "".join(f'<sheet name="{escape(t)}" sheetId="{i}" r:id="rId{i}"/>' for i, t in enumerate(sheets, start=1))
    relations = "\n".join(_RELATION.format(i, file) for i, file in enumerate(files, start=1))
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for part, xml in parts.items():
            for slot, text in (("{sheets}", entries), ("{relations}", relations), ("{styles}", str(len(files) + 1))):
                xml = xml.replace(slot, text)
            # ZipInfo dates the member 1980, so that a system always gives the same file.
            archive.writestr(zipfile.ZipInfo(part), xml, zipfile.ZIP_DEFLATED)
    return memory.getvalue(), stored


def new_sheets(system: Scanner, styled: bool = True) -> tuple[dict[str, dict[int, str]], dict[str, Any]]:
    """Return the sheets in the layout of the scanner's kind, and the values that their formulas store: address -> value.

    The sheets are title -> {row: XML of the row}. Optional columns without a formula that could be blank in all modules are
    left out.
    """
    refuse_unwritable(system)
    definitions, places = system.columns, _sheets_and_columns(system)
    main = places[definitions.leading][0]
    titles = sorted(dict.fromkeys(title for title, _ in places.values()), key=lambda title: title == main)
    numbers = [(number, "") for number in system.numbers.tolist()]
    heading = _HEADING if styled else _NORMAL
    cells = {title: {1: _column_xml(1, ("", "Definitions"), numbers, (heading, _NORMAL))} for title in titles}
    stored: dict[str, Any] = {}
    for definition in (*definitions.values(), *definitions.unread):
        if definition.is_unused(system):
            continue
        (title, column), content = places[definition.name], _column_content(definition, system, places)
        style = _FOUR_DECIMALS if styled and title == main and not definition.is_text else _NORMAL
        cells[title][column] = _column_xml(column, definition.heading(), content, (heading, style))
        rows = enumerate(content, start=_FIRST_ROW)
        stored |= {f"{title}!{cell_name((row, column))}": value for row, (value, formula) in rows if formula}
    return {title: _rows_xml(columns) for title, columns in cells.items()}, stored


def _sheets_and_columns(system: Scanner) -> dict[str, tuple[str, int]]:
    """Return name of a scanner's column -> (title of its sheet, its column there, counted from 1).

    Columns whose definition names no place are put right of all columns in the sheet of the leading column.
    """
    from openpyxl.utils import column_index_from_string as index

    definitions = [*system.columns.values(), *system.columns.unread]
    declared = [(definition.name, *definition.place.partition("!")) for definition in definitions]
    places = {name: (title, index(letters)) for name, title, _, letters in declared if title}
    main = places[system.columns.leading][0] if system.columns.leading in places else system.sheet or "Coordinates"
    last = max((column for title, column in places.values() if title == main), default=1)
    free = (definition.name for definition in definitions if definition.name not in places)
    return places | {name: (main, column) for column, name in enumerate(free, start=last + 1)}


def _column_content(definition: Column, system: Scanner, places: dict[str, tuple[str, int]]) -> _Content:
    """Return (value, formula) of each module's cell in a column; the formula is "" where it does not give the value."""
    title, values = places[definition.name][0], definition.values(system)
    numbers = (values if definition.is_text else values / next(iter(definition.units.values()))).tolist()
    if not definition.formula:
        return [(number, "") for number in numbers]
    follows_formula = definition.follows_formula(system)
    undefined = follows_formula & definition.undefined(system.columns.needed_values(system))
    quoted = {name: name if re.fullmatch(r"\w+", name) else f"'{name}'" for name, _ in places.values()}
    prefixes = {name: "" if sheet == title else f"{quoted[sheet]}!" for name, (sheet, _) in places.items()}
    content = []
    modules = zip(numbers, follows_formula, undefined, strict=True)
    for row, (number, is_formula, is_undefined) in enumerate(modules, start=_FIRST_ROW):
        cells = {name: prefixes[name] + cell_name((row, column)) for name, (_, column) in places.items()}
        value = CellError("#DIV/0!") if is_undefined or number in _INFINITE else number
        content.append((value, definition.formula.format_map(cells) if is_formula else ""))
    return content


def refuse_unwritable(system: Scanner) -> None:
    """Raise `InputError` for a scanner that would be refused in any workbook, or read as another scanner."""
    cannot, numbers, definitions = "the new workbook cannot hold this system", system.numbers, system.columns
    if len(numbers) > MAX_MODULES:
        raise InputError(f"{cannot}: it has {len(numbers)} modules, expected at most {MAX_MODULES}")
    with np.errstate(over="ignore", invalid="ignore"):
        arrays = {"number": numbers.astype(np.float64), **{name: c.values(system) for name, c in definitions.items()}}
    for name, values in arrays.items():
        limit = _LARGEST_NUMBER if name == "number" else np.finfo(np.float64).max
        for i in first_true(~(np.abs(values) <= limit)) if values.dtype.kind == "f" else ():
            raise InputError(f"{cannot}: {name} of module {numbers[i]} is {values[i]:g}, expected at most {limit:g}")
    places = _sheets_and_columns(system)

    def address_text(name: str, i: int) -> str:
        """Return the address of the cell of a column and a module's index."""
        title, column = places[name]
        return f"{title}!{cell_name((_FIRST_ROW + i, column))}"

    for name, i, problem in system.faults(definitions.needed_values(system), numbers.tolist(), address_text):
        raise InputError(f"{cannot}, with it: the new workbook: {address_text(name, i)} {problem}")


def _column_xml(column: int, headings: tuple[str, str], content: _Content, styles: tuple[int, int]) -> list[str]:
    """Return the XML of a column's cells from row 1 down: two headings, then (value, formula) of each module.

    `styles` are the numbers of the style of the headings and of the style of the other cells.
    """
    heading_style, style = styles
    cells = [_cell_xml(cell_name((row, column)), text, heading_style) for row, text in enumerate(headings, start=1)]
    rows = enumerate(content, start=_FIRST_ROW)
    return cells + [_cell_xml(cell_name((row, column)), value, style, formula) for row, (value, formula) in rows]


def _cell_xml(name: str, value: Any, style: int, formula: str = "") -> str:
    """Return the XML of the cell `name`, such as B3; an empty text is stored as no value."""
    cell_type = f' t="{"e" if isinstance(value, CellError) else "str"}"' if isinstance(value, str) else ""
    text = escape(value) if isinstance(value, str) else repr(value).removesuffix(".0")
    content = (f"<f>{escape(formula[1:])}</f>" if formula else "") + (f"<v>{text}</v>" if text else "")
    return f'<c r="{name}" s="{style}"{cell_type}>{content}</c>'


def _rows_xml(columns: dict[int, list[str]]) -> dict[int, str]:
    """Return row -> its XML, from the XML of the cells of each column, from row 1 down."""
    rows = enumerate(zip(*[columns[column] for column in sorted(columns)], strict=True), start=1)
    return {row: f'<row r="{row}">{"".join(cells)}</row>' for row, cells in rows}
