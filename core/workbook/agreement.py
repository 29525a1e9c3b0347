"""Whether what a cell holds is what it should hold."""

from typing import Any

from ..geometry.columns import AGREEING, LENGTH_UNITS

EXACT = 1e-6
"""Two numbers of one column agree if they differ less: relative, and absolute in mm or rad."""
_COARSEST_ROUNDING = {"rad": 5e-4, "deg": 5e-3, "": 5e-3}
_COARSEST_ROUNDING |= {unit: 0.005 / factor for unit, factor in LENGTH_UNITS.items()}
"""Unit -> the largest rounding error that a typed number is granted."""


def tolerance(number: float, expected: float, unit: str) -> float:
    """By how much a number in a cell may differ from the expected one, all in `unit`.

    That is `EXACT`, or half a unit of the number's last decimal, whichever is more.
    """
    text = f"{number:.12g}"
    decimals = len(text.partition(".")[2]) if "e" not in text else 12
    # Trailing zeros are lost: 89.1 may be 89.10, so few decimals stand for the coarsest rounding.
    rounding = min(0.5 * 10.0**-decimals, _COARSEST_ROUNDING[unit])
    return max(EXACT * max(1.0 / LENGTH_UNITS.get(unit, 1.0), abs(expected)), rounding * (1 + 1e-9))


def agree(value: Any, wanted: float | str, at_least: float = 0.0) -> bool:
    """Whether a cell's value is that text, or that number, relative to it and `at_least`."""
    if isinstance(wanted, str):
        return text_of(value) == wanted
    return type(value) is float and abs(value - wanted) <= AGREEING * max(abs(wanted), at_least)


def text_of(value: Any) -> str | None:
    """The text that a cell of texts holds: what it shows, "" if blank; None for fractions, errors and the like."""
    if value is None or type(value) is str:
        return (value or "").strip()
    return f"{value:.0f}" if type(value) is float and value.is_integer() and abs(value) < 2**53 else None
