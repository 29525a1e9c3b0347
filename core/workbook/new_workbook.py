"""A geometry workbook in the users' layout: sheets Main and Coordinates, with the modules from row 3 on."""

from __future__ import annotations

import io

from ..geometry.system import PinholeSystem
from .plausibility import is_by_design
from .quantities import QUANTITIES

# Sheet -> column -> quantity, symbol and description.
_COLUMNS = {
    "Main": {
        "A": ("number", "", "Definitions"),
        "P": ("d", "d", "diameter of pinhole"),
        "Q": ("R", "R", "radius of spherical region of interest"),
        "S": ("Ld", "Ld", "length of side of detector crystal"),
        "T": ("Td", "Td", "thickness of detector crystal"),
    },
    "Coordinates": {
        "A": ("number", "", "Definitions"),
        "B": ("x1", "x1", "x coordinate value at center of hole"),
        "C": ("y1", "y1", "y coordinate value at center of hole"),
        "D": ("z1", "z1", "z coordinate value at center of hole"),
        "E": ("b", "b", "distance from center of hole to center of heart"),
        "F": ("slope", "S", "3D slope"),
        "G": ("l", "l", "length of collimator"),
        "H": ("H", "l + b+Td", ""),
        "I": ("x2", "x2", "x coordinate value at end of detector"),
        "J": ("y2", "y2", "y coordinate value at end of detector"),
        "K": ("z2", "z2", "z coordinate value at end of detector"),
        "U": ("range", "", "pinhole range"),
        "V": ("azimuth", "", "pinhole azimuth (radians)"),
        "W": ("elevation", "", "pinhole elevation (radians)"),
    },
}
_FORMULAS = {name: quantity.formula for name, quantity in QUANTITIES.items()} | {"number": "", "slope": "={b}/{x1}"}
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
    for title, columns in _COLUMNS.items():
        sheet = book[title]
        sheet.freeze_panes = "B3"
        places = {
            name: letter if other == title else f"{other}!{letter}"
            for other in _COLUMNS
            for letter, (name, _, _) in _COLUMNS[other].items()
        }
        for letter, (name, *texts) in columns.items():
            sheet.column_dimensions[letter].width = _WIDTH
            for row, text in enumerate(texts, start=1):
                cell = sheet[f"{letter}{row}"]
                cell.value, cell.font = text or None, Font(bold=True)
                cell.alignment = Alignment(wrap_text=True, vertical="top", horizontal="center")
            for i, row in enumerate(range(_FIRST_ROW, _FIRST_ROW + len(system))):
                cell = sheet[f"{letter}{row}"]
                if _FORMULAS[name] and (name != "l" or by_design[i]):
                    cell.value = _FORMULAS[name].format_map({of: f"{place}{row}" for of, place in places.items()})
                else:
                    cell.value = float(QUANTITIES[name].of(system)[i]) if name in QUANTITIES else int(system.numbers[i])
                if title == "Coordinates" and name != "number":
                    cell.number_format = "0.0000"
    content = io.BytesIO()
    book.save(content)
    return content.getvalue()
