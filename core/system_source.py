"""Where in which workbook a system's numbers stand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .workbook.column_map import ColumnMap


@dataclass(frozen=True)
class QuantityCells:
    """The cells of one quantity.

    Attributes
    ----------
    quantity : str
        The symbol: "number", "x1", "y1", "z1", "b", "l", "H", "x2", "y2", "z2", "range", "azimuth",
        "elevation", "d", "R", "Ld" or "Td".
    sheet : str
    column : str
        The column's letters.
    rows : tuple of int
        The row of each module of `SystemSource.numbers`, in their order; the same where one value stands for all.
    """

    quantity: str
    sheet: str
    column: str
    rows: tuple[int, ...]


@dataclass(frozen=True)
class SystemSource:
    """The workbook a system was read from.

    Attributes
    ----------
    path : Path
        Absolute.
    sha256 : str
        Of the file's bytes, hexadecimal.
    coordinates_sheet : str
        The sheet of x1, y1, z1.
    dimensions_sheet : str
        The sheet of the pinhole diameter d; `cells` knows those of R, Ld and Td, should they differ.
    numbers : tuple of int
        The modules' numbers in the order of their rows. A part of a system keeps the whole system's source.
    cells : tuple of QuantityCells
        One for each quantity that has a column.
    columns : ColumnMap or None
        The column map that it was read by; None where its headings were understood.
    """

    path: Path
    sha256: str
    coordinates_sheet: str
    dimensions_sheet: str
    numbers: tuple[int, ...]
    cells: tuple[QuantityCells, ...]
    columns: ColumnMap | None = None

    def cell(self, quantity: str, number: int) -> tuple[str, str] | None:
        """(sheet, cell), e.g. ``("Coordinates", "B3")``, of a module's `quantity`; None without a column."""
        row_of_module = self.numbers.index(number)
        for cells in self.cells:
            if cells.quantity == quantity:
                return cells.sheet, f"{cells.column}{cells.rows[row_of_module]}"
        return None
