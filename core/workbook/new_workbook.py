"""A geometry workbook in the users' layout: sheets Main and Coordinates, the modules from row 3 on."""

from __future__ import annotations

import io

from ..system import PinholeSystem
from .checks import is_by_design

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


def new_workbook(system: PinholeSystem) -> bytes:
    """The file, its formulas without values; l is a number where it is not the design formula's."""
    import openpyxl

    by_design = is_by_design(system)

    book = openpyxl.Workbook()
    main = book.active
    main.title = "Main"
    coordinates = book.create_sheet("Coordinates")
    for sheet, headings in ((main, _MAIN), (coordinates, _COORDINATES)):
        _head(sheet, headings)
    for i, number in enumerate(system.numbers):
        row = i + 3
        main[f"A{row}"] = coordinates[f"A{row}"] = int(number)
        for column, values in (
            ("P", system.pinhole_diameter),
            ("Q", system.roi_radius),
            ("S", system.detector_side),
            ("T", system.detector_thickness),
        ):
            main[f"{column}{row}"] = float(values[i])
        for column, value in zip("BCD", system.centers[i], strict=True):
            coordinates[f"{column}{row}"] = float(value)
        for column, formula in _FORMULAS.items():
            coordinates[f"{column}{row}"] = formula.format(row)
        if not by_design[i]:
            coordinates[f"G{row}"] = float(system.collimator_length[i])
        for column in "BCDEFGHIJKUVW":
            coordinates[f"{column}{row}"].number_format = "0.0000"
    content = io.BytesIO()
    book.save(content)
    return content.getvalue()


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
