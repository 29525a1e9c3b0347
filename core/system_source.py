"""Where in which workbook a system's numbers are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class QuantityCells:
    """The cells of one quantity."""

    quantity: str  # "number", or the name of a column of the scanner's kind (core.geometry), such as "x1"
    sheet: str
    column: str  # its letters
    rows: tuple[int, ...]  # of each of `SystemSource.numbers`, in their order; all the same if one value holds for all


@dataclass(frozen=True)
class SystemSource:
    """The workbook that a system was read from. A part of a system keeps the whole system's source."""

    path: Path  # absolute
    sha256: str  # of the file's bytes, hexadecimal
    coordinates_sheet: str  # of x1, y1, z1
    dimensions_sheet: str  # of the pinhole diameter d; those of R, Ld and Td, which may differ, are in `cells`
    numbers: tuple[int, ...]  # the modules', in the order of their rows
    cells: tuple[QuantityCells, ...]  # one for each quantity that has a column
    columns: Any = None  # the ColumnMap that it was read by (of core.workbook); None if its headings were understood

    def cell(self, quantity: str, number: int) -> tuple[str, str] | None:
        """(sheet, cell) of a module's `quantity`, e.g. ``("Coordinates", "B3")``; None without a column."""
        i = self.numbers.index(number)
        found = (c for c in self.cells if c.quantity == quantity)
        return next(((c.sheet, f"{c.column}{c.rows[i]}") for c in found), None)
