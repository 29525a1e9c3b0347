"""The users' geometry workbook (.xlsx): the pinholes' coordinates and their dimensions.

book.py      the file: opened, refused, its cells as Python values
formulas.py  formulas that a program stored without their values
headings.py  which column holds which quantity, found by symbols ("x1") and descriptions
rows.py      which rows hold the modules
checks.py    the sheet's own derived numbers against the formulas
reader.py    `read_system`, which joins these
source.py    `SystemSource`, where each number came from
"""

from __future__ import annotations

from .reader import read_system
from .source import QuantityCells, SystemSource

__all__ = ["QuantityCells", "SystemSource", "read_system"]
