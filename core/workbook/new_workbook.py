"""A geometry workbook in the users' layout: sheets Main and Coordinates, with the modules from row 3 on."""

from __future__ import annotations

import io

from ..geometry.system import PinholeSystem
from .plausibility import is_by_design
from .quantities import QUANTITIES

_WIDTH = 13
_FIRST_ROW = 3


def new_workbook(system: PinholeSystem) -> bytes:
    """The workbook's file, its formulas without values; l is a number where it is not the design formula's."""
    import openpyxl
    from openpyxl.styles import Alignment, Font

    book = openpyxl.Workbook()
    book.active.title = "Main"
    book.create_sheet("Coordinates")
    by_design = is_by_design(system)
    columns = [
        *((name, q.place, q.titles or q.headings[:2], q.formula, q.of(system)) for name, q in QUANTITIES.items()),
        *(("number", f"{title}!A", ("", "Definitions"), "", system.numbers) for title in book.sheetnames),
        ("slope", "Coordinates!F", ("S", "3D slope"), "={b}/{x1}", by_design),
    ]
    for name, place, titles, formula, numbers in columns:
        title, letter = place.split("!")
        sheet = book[title]
        sheet.freeze_panes = "B3"
        sheet.column_dimensions[letter].width = _WIDTH
        for row, text in enumerate(titles, start=1):
            cell = sheet[f"{letter}{row}"]
            cell.value, cell.font = text or None, Font(bold=True)
            cell.alignment = Alignment(wrap_text=True, vertical="top", horizontal="center")
        places = {other: quantity.place.removeprefix(f"{title}!") for other, quantity in QUANTITIES.items()}
        for i, number in enumerate(numbers):
            row = _FIRST_ROW + i
            cell = sheet[f"{letter}{row}"]
            cell.value = number.item()
            if formula and (name != "l" or by_design[i]):
                cell.value = formula.format_map({other: f"{column}{row}" for other, column in places.items()})
            if title == "Coordinates" and name != "number":
                cell.number_format = "0.0000"
    content = io.BytesIO()
    book.save(content)
    return content.getvalue()
