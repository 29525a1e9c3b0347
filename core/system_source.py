"""Source of a scanner's numbers: its workbook, and the cells that hold the numbers."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class QuantityCells:
    """Cells of a workbook that hold one quantity of all modules."""

    quantity: str  # "number", or the name of a column of the scanner's kind (core.geometry), such as "x1"
    sheet: str  # name of the sheet
    column: str  # letters of the column
    rows: tuple[int, ...]  # row of each module, in the order of `SystemSource.numbers`; all equal for a common value


@dataclass(frozen=True)
class SystemSource:
    """Workbook that a system was read from. A part of a system keeps the source of the whole system."""

    path: Path  # absolute path of the file
    sha256: str  # SHA-256 of the file's bytes, hexadecimal
    coordinates_sheet: str  # name of the sheet with x1, y1, z1
    dimensions_sheet: str  # name of the sheet with the pinhole diameter d; R, Ld and Td may be on others, see `cells`
    numbers: tuple[int, ...]  # numbers of the modules, in the order of their rows
    cells: tuple[QuantityCells, ...]  # cells of each quantity that has a column
    columns: Any = None  # `ColumnMap` (core.workbook) by which the file was read; None if its headings were understood

    def cell(self, quantity: str, number: int) -> tuple[str, str] | None:
        """Return the sheet and cell of a `quantity` of the module with this number, such as ("Coordinates", "B3").

        Returns None if the workbook has no column for the quantity.
        """
        i = self.numbers.index(number)
        matches = (cells for cells in self.cells if cells.quantity == quantity)
        return next(((cells.sheet, f"{cells.column}{cells.rows[i]}") for cells in matches), None)
