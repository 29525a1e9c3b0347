"""What a cell may hold besides a number, and how messages describe it."""

from __future__ import annotations

from typing import Any, NamedTuple

from .formulas import CellError
from .sheet_xml import Unreadable


class Uncomputed(str):
    """Stands for a formula without a reliable stored value that cannot be computed here; the text says why."""


class Outdated(NamedTuple):
    """Stands for a formula whose stored value is not what it gives."""

    stored: Any
    computed: Any


def module_number(value: Any) -> int | None:
    """The whole number in a cell, stored as a number or as text; None for anything else."""
    if type(value) is str:
        text = value.strip()
        return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else None
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return None


def description(value: Any, formula: str | None) -> str:
    """What a cell holds, as the predicate of a message: "is blank"."""
    if value is None:
        return "is blank"
    if isinstance(value, Uncomputed):
        return (
            f"holds the formula {shortened(formula or '')} without a stored value ({shortened(value, 80)}; opening the "
            "workbook in Excel or LibreOffice and saving it stores the value)"
        )
    if isinstance(value, Outdated):
        return (
            f"stores {_number(value.stored)}, but its formula {shortened(formula or '')} gives {_number(value.computed)} "
            "(opening the workbook in Excel or LibreOffice and saving it stores the right value)"
        )
    if isinstance(value, CellError):
        return f"shows the error {value}"
    if isinstance(value, bool):
        return f"is {str(value).upper()}"
    if isinstance(value, Unreadable):
        return f"holds {shortened(value)!r}, which is not a number"
    if isinstance(value, str):
        return f"holds the text {shortened(value)!r}"
    return f"is {value:g}" if isinstance(value, float) else f"holds {shortened(str(value))}"


def _number(value: Any) -> str:
    return f"{value:.9g}" if type(value) is float else repr(value)


def shortened(text: str, longest: int = 40) -> str:
    """A text on one line, cut off if it is long."""
    text = " ".join(text.split())
    return text if len(text) <= longest else text[: longest - 1] + "…"
