"""Cells that must hold a number, and what to say of those that don't."""

from __future__ import annotations

import math
from typing import Any

from ..errors import InputError
from .book import Outdated, Sheet, Uncomputed
from .formulas import CellError
from .sheet_xml import Unreadable


def length(sheet: Sheet, row: int, column: int, quantity: str, of: str = "") -> float:
    """The number in a cell, which must not be blank."""
    value = sheet.value(row, column)
    if isinstance(value, float) and math.isfinite(value) and not sheet.is_date(row, column):
        return value
    raise InputError(f"{where(sheet, row, column)} {found(sheet, row, column)}, expected {quantity}{of}, a number")


def module_number(value: Any) -> int | None:
    """The whole number that a cell's value is, as a number or as text; None for anything else."""
    if type(value) is str:
        text = value.strip()
        return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return None


def where(sheet: Sheet, row: int, column: int) -> str:
    """File, sheet and cell: how every message about a cell begins."""
    return f"{sheet.book.path.name}: {sheet.place(row, column)}"


def found(sheet: Sheet, row: int, column: int) -> str:
    """What is in a cell, as the predicate of a message."""
    value = sheet.value(row, column)
    if value is None:
        return "is blank"
    if isinstance(value, Uncomputed):
        formula = _short(sheet.formula(row, column) or "")
        return (
            f"holds the formula {formula} without a stored value ({_short(value, 80)}; opening the workbook in "
            "Excel or LibreOffice and saving it stores the value)"
        )
    if isinstance(value, Outdated):
        formula = _short(sheet.formula(row, column) or "")
        return (
            f"stores {_number(value.stored)}, but its formula {formula} gives {_number(value.computed)} (opening the "
            "workbook in Excel or LibreOffice and saving it stores the right value)"
        )
    if isinstance(value, CellError):
        return f"shows the error {value}"
    if isinstance(value, bool):
        return f"is {str(value).upper()}"
    if isinstance(value, float) and sheet.is_date(row, column):
        return f"is formatted as a date or time ({sheet.number_format(row, column)})"
    if isinstance(value, Unreadable):
        return f"holds {_short(value)!r}, which is no number"
    if isinstance(value, str):
        return f"holds the text {_short(value)!r}"
    return f"is {value:g}" if isinstance(value, float) else f"holds {_short(str(value))}"


def _number(value: Any) -> str:
    return f"{value:.9g}" if type(value) is float else repr(value)


def _short(text: str, longest: int = 40) -> str:
    text = " ".join(text.split())
    return text if len(text) <= longest else text[: longest - 1] + "…"
