"""Comparison of the value of a cell with the value that it should have."""

from typing import Any

from ..geometry.columns import AGREEING, LENGTH_UNITS

EXACT = 1e-6
"""Largest difference of two numbers of one column that agree: relative, and absolute in mm or rad."""
_COARSEST_ROUNDING = {"rad": 5e-4, "deg": 5e-3, "": 5e-3} | {unit: 0.005 / mm for unit, mm in LENGTH_UNITS.items()}
"""Unit -> largest rounding error, in that unit, that is assumed of a typed number."""


def tolerance(number: float, expected: float, unit: str) -> float:
    """Return the largest allowed difference between the number in a cell and the expected number, all in `unit`.

    The tolerance is `EXACT`, or half a unit of the number's last decimal if that is more.
    """
    text = f"{number:.12g}"
    decimals = len(text.partition(".")[2]) if "e" not in text else 12
    # A cell shows no trailing zeros: 89.1 may be 89.10, so a number of few decimals gets the coarsest rounding.
    rounding = min(0.5 * 10.0**-decimals, _COARSEST_ROUNDING[unit])
    return max(EXACT * max(1.0 / LENGTH_UNITS.get(unit, 1.0), abs(expected)), rounding * (1 + 1e-9))


def agree(value: Any, expected: float | str, at_least: float = 0.0) -> bool:
    """Return whether a cell's value is the expected text, or the expected number to the relative error `AGREEING`.

    The error is relative to the larger of the expected number and `at_least`.
    """
    if isinstance(expected, str):
        return cell_text(value) == expected
    return type(value) is float and abs(value - expected) <= AGREEING * max(abs(expected), at_least)


def cell_text(value: Any) -> str | None:
    """Return the value of a cell as the text that a text column takes: "" if blank, a whole number without decimals.

    Returns None for a value that is no text: a fraction, a boolean, an error.
    """
    if value is None or type(value) is str:
        return (value or "").strip()
    return f"{value:.0f}" if type(value) is float and value.is_integer() and abs(value) < 2**53 else None
