"""A scanner in a new workbook, or in a new sheet for one, in one pass and with its own values in the formulas."""

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
"""The XML of a new workbook, its parts one after another, with their names above them; the last one is a sheet."""
_RELATION = (
    '<Relationship Id="rId{}" Type="http://schemas.openxmlformats.org/officeDocument/2006/relationships/worksheet" '
    'Target="worksheets/{}.xml"/>'
)
_NORMAL, _HEADING, _FOUR_DECIMALS = range(3)
"""Its styles of cells."""
_FIRST_ROW = 3
_LARGEST_NUMBER = 2**53 - 1
"""The first module's row, and the largest module's number that a cell holds exactly."""
_INFINITE = math.inf, -math.inf


def new_workbook(system: Scanner) -> tuple[bytes, dict[str, Any]]:
    """A workbook in the layout of the scanner's kind, and the value that each formula stores: the scanner's own."""
    sheets, stored = new_sheets(system)
    files = [re.sub(r"[^\w-]", "_", title, flags=re.ASCII) for title in sheets]
    parts = dict(part.split("\n", 1) for part in _PARTS.read_text(encoding="ascii").split("--- ")[1:])
    path, sheet = parts.popitem()
    for i, (file, rows) in enumerate(zip(files, sheets.values(), strict=True)):
        selected = "" if i else ' tabSelected="1"'
        parts[path.format(file=file)] = sheet.format(selected=selected, rows="".join(rows.values()))
    named = "".join(f'<sheet name="{escape(t)}" sheetId="{i}" r:id="rId{i}"/>' for i, t in enumerate(sheets, start=1))
    relations = "\n".join(_RELATION.format(i, file) for i, file in enumerate(files, start=1))
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for part, xml in parts.items():
            for place, text in (("{sheets}", named), ("{relations}", relations), ("{styles}", str(len(files) + 1))):
                xml = xml.replace(place, text)
            # Dated 1980, so that a system always gives the same file.
            archive.writestr(zipfile.ZipInfo(part), xml, zipfile.ZIP_DEFLATED)
    return memory.getvalue(), stored


def new_sheets(system: Scanner, styled: bool = True) -> tuple[dict[str, dict[int, str]], dict[str, Any]]:
    """The XML of the rows of each sheet in the layout of the scanner's kind, by their numbers, and what formulas store.

    Optional columns without a formula that could be blank in all modules are left out.
    """
    refuse_unreadable(system)
    declared, places = system.columns, _places(system)
    main = places[declared.leading][0]
    titles = sorted(dict.fromkeys(title for title, _ in places.values()), key=lambda title: title == main)
    numbers = [(number, "") for number in system.numbers.tolist()]
    heading = _HEADING if styled else _NORMAL
    cells = {title: {1: _column(1, ("", "Definitions"), numbers, (heading, _NORMAL))} for title in titles}
    stored: dict[str, Any] = {}
    for column in (*declared.values(), *declared.unread):
        if column.is_unused(system):
            continue
        (title, at), content = places[column.name], _content(column, system, places)
        style = _FOUR_DECIMALS if styled and title == main and not column.is_text else _NORMAL
        cells[title][at] = _column(at, column.heading(), content, (heading, style))
        rows = enumerate(content, start=_FIRST_ROW)
        stored |= {f"{title}!{cell_name((row, at))}": value for row, (value, formula) in rows if formula}
    return {title: _rows(its) for title, its in cells.items()}, stored


def _places(system: Scanner) -> dict[str, tuple[str, int]]:
    """Column of the scanner -> its sheet and column there; those without a place of their own stand right of the others."""
    from openpyxl.utils import column_index_from_string as index

    columns = [*system.columns.values(), *system.columns.unread]
    named = [(column.name, *column.place.partition("!")) for column in columns]
    placed = {name: (title, index(letters)) for name, title, _, letters in named if title}
    main = placed[system.columns.leading][0] if system.columns.leading in placed else system.sheet or "Coordinates"
    last = max((at for title, at in placed.values() if title == main), default=1)
    free = (column.name for column in columns if column.name not in placed)
    return placed | {name: (main, at) for at, name in enumerate(free, start=last + 1)}


def _content(column: Column, system: Scanner, places: dict[str, tuple[str, int]]) -> list[tuple[Any, str]]:
    """The value and the formula, "" where that does not give the value, of each module's cell of a column."""
    title, held = places[column.name][0], column.values(system)
    values = (held if column.is_text else held / next(iter(column.units.values()))).tolist()
    if not column.formula:
        return [(value, "") for value in values]
    by_formula = column.follows_formula(system)
    undefined = by_formula & column.undefined(system.columns.needed_values(system))
    quoted = {its: its if re.fullmatch(r"\w+", its) else f"'{its}'" for its, _ in places.values()}
    before = {name: "" if its == title else f"{quoted[its]}!" for name, (its, _) in places.items()}
    content = []
    for row, (value, own, bad) in enumerate(zip(values, by_formula, undefined, strict=True), start=_FIRST_ROW):
        cells = {name: before[name] + cell_name((row, at)) for name, (_, at) in places.items()}
        shown = CellError("#DIV/0!") if bad or value in _INFINITE else value
        content.append((shown, column.formula.format_map(cells) if own else ""))
    return content


def refuse_unreadable(system: Scanner) -> None:
    """Refuse a scanner that would be refused in any workbook, or read as another."""
    cannot, numbers, declared = "the new workbook cannot hold this system", system.numbers, system.columns
    if len(numbers) > MAX_MODULES:
        raise InputError(f"{cannot}: it has {len(numbers)} modules, expected at most {MAX_MODULES}")
    with np.errstate(over="ignore", invalid="ignore"):
        held = {"number": numbers.astype(np.float64), **{name: c.values(system) for name, c in declared.items()}}
    for name, values in held.items():
        most = _LARGEST_NUMBER if name == "number" else np.finfo(np.float64).max
        for i in first_true(~(np.abs(values) <= most)) if values.dtype.kind == "f" else ():
            raise InputError(f"{cannot}: {name} of module {numbers[i]} is {values[i]:g}, expected at most {most:g}")
    places = _places(system)

    def place(name: str, i: int) -> str:
        title, at = places[name]
        return f"{title}!{cell_name((_FIRST_ROW + i, at))}"

    for name, i, why in system.faults(declared.needed_values(system), numbers.tolist(), place):
        raise InputError(f"{cannot}, with it: the new workbook: {place(name, i)} {why}")


def _column(at: int, titles: tuple[str, str], content: list[tuple[Any, str]], styles: tuple[int, int]) -> list[str]:
    """The XML of a column's cells, from row 1 down: its titles, then values with their formulas, in these two styles."""
    heading, style = styles
    cells = [_cell(cell_name((row, at)), title, heading) for row, title in enumerate(titles, start=1)]
    rows = enumerate(content, start=_FIRST_ROW)
    return cells + [_cell(cell_name((row, at)), value, style, formula) for row, (value, formula) in rows]


def _cell(place: str, value: Any, style: int, formula: str = "") -> str:
    """A cell's XML; an empty text is no value."""
    kind = f' t="{"e" if isinstance(value, CellError) else "str"}"' if isinstance(value, str) else ""
    shown = escape(value) if isinstance(value, str) else repr(value).removesuffix(".0")
    content = (f"<f>{escape(formula[1:])}</f>" if formula else "") + (f"<v>{shown}</v>" if shown else "")
    return f'<c r="{place}" s="{style}"{kind}>{content}</c>'


def _rows(columns: dict[int, list[str]]) -> dict[int, str]:
    """Row -> its XML, of a sheet's columns of cells."""
    in_order = [columns[at] for at in sorted(columns)]
    numbered = enumerate(zip(*in_order, strict=True), start=1)
    return {row: f'<row r="{row}">{"".join(cells)}</row>' for row, cells in numbered}
