"""A geometry workbook in the users' layout: sheets Main and Coordinates, the modules from row 3 on."""

from __future__ import annotations

import io

from ..geometry.system import PinholeSystem
from .plausibility import is_by_design
from .workbook_xml import Place, WorkbookXml

# Column -> symbol, description.
_MAIN = {
    "A": ("", "Definitions"),
    "P": ("d", "diameter of pinhole"),
    "Q": ("R", "radius of spherical region of interest"),
    "S": ("Ld", "length of side of detector crystal"),
    "T": ("Td", "thickness of detector crystal"),
}
_COORDINATES = {
    "A": ("", "Definitions"),
    "B": ("x1", "x coordinate value at center of hole"),
    "C": ("y1", "y coordinate value at center of hole"),
    "D": ("z1", "z coordinate value at center of hole"),
    "E": ("b", "distance from center of hole to center of heart"),
    "F": ("S", "3D slope"),
    "G": ("l", "length of collimator"),
    "H": ("l + b+Td", ""),
    "I": ("x2", "x coordinate value at end of detector"),
    "J": ("y2", "y coordinate value at end of detector"),
    "K": ("z2", "z coordinate value at end of detector"),
    "U": ("", "pinhole range"),
    "V": ("", "pinhole azimuth (radians)"),
    "W": ("", "pinhole elevation (radians)"),
}
_FORMULAS = {
    "E": "=SQRT(SUMSQ(B{0},C{0},D{0}))",
    "F": "=E{0}/B{0}",
    "G": "=(Main!S{0}-Main!P{0})*(E{0}^2-Main!Q{0}^2)"
    "/(E{0}*Main!P{0}+2*Main!Q{0}*SQRT(E{0}^2-Main!Q{0}^2+Main!P{0}^2/4))",
    "H": "=E{0}+G{0}+Main!T{0}",
    "I": "=B{0}*H{0}/E{0}",
    "J": "=C{0}*H{0}/E{0}",
    "K": "=D{0}*H{0}/E{0}",
    "U": "=SQRT(SUMSQ(B{0},C{0}))",
    "V": "=(ATAN2(B{0},C{0}))",
    "W": "=(ATAN2(U{0},D{0}))",
}
_WIDTH = 13
FIRST_ROW = 3


def new_workbook(system: PinholeSystem) -> WorkbookXml:
    """The workbook, its formulas without values; l is a number where it is not the design formula's."""
    import openpyxl

    book = openpyxl.Workbook()
    main = book.active
    main.title = "Main"
    coordinates = book.create_sheet("Coordinates")
    for sheet, headings in ((main, _MAIN), (coordinates, _COORDINATES)):
        _head(sheet, headings)
    numbers = numbers_of(system)
    for (title, row, column), number in numbers.items():
        book[title].cell(row, column, number)
    by_design = is_by_design(system)
    for i, row in enumerate(range(FIRST_ROW, FIRST_ROW + len(system))):
        for letter, formula in _FORMULAS.items():
            if letter != "G" or by_design[i]:
                coordinates[f"{letter}{row}"] = formula.format(row)
        for letter in "BCDEFGHIJKUVW":
            coordinates[f"{letter}{row}"].number_format = "0.0000"
    content = io.BytesIO()
    book.save(content)
    workbook = WorkbookXml(content.getvalue(), "the new workbook")
    for (title, *at), number in numbers.items():  # with all their digits, of which openpyxl writes 16
        if workbook.sheets[title].cells[at[0], at[1]].formula is None:
            workbook.sheets[title].type((at[0], at[1]), number)
    return workbook


def numbers_of(system: PinholeSystem) -> dict[Place, float]:
    """The numbers that the cells of the workbook hold, or their formulas give, of the modules and l."""
    columns = {
        ("Main", 1): system.numbers,
        ("Main", 16): system.pinhole_diameter,
        ("Main", 17): system.roi_radius,
        ("Main", 19): system.detector_side,
        ("Main", 20): system.detector_thickness,
        ("Coordinates", 1): system.numbers,
        ("Coordinates", 2): system.centers[:, 0],
        ("Coordinates", 3): system.centers[:, 1],
        ("Coordinates", 4): system.centers[:, 2],
        ("Coordinates", 7): system.collimator_length,
    }
    return {
        (title, row, column): float(number)
        for (title, column), numbers in columns.items()
        for row, number in enumerate(numbers, start=FIRST_ROW)
    }


def _head(sheet, headings: dict[str, tuple[str, str]]) -> None:  # type: ignore[no-untyped-def]
    from openpyxl.styles import Alignment, Font

    for column, texts in headings.items():
        for row, text in enumerate(texts, start=1):
            cell = sheet[f"{column}{row}"]
            cell.value = text or None
            cell.font = Font(bold=True)
            cell.alignment = Alignment(wrap_text=True, vertical="top", horizontal="center")
        sheet.column_dimensions[column].width = _WIDTH
    sheet.freeze_panes = "B3"
