"""How numbers in cells are compared, and the names of the pinholes' columns."""

from ..geometry.columns import AGREEING, LENGTH_UNITS, Values
from ..geometry.pinhole_columns import PINHOLE_COLUMNS

QUANTITIES = PINHOLE_COLUMNS
Numbers = Values
NEEDED, OPTIONAL, DERIVED, TYPED = QUANTITIES.needed, QUANTITIES.optional, QUANTITIES.derived, QUANTITIES.typed
POSITION, DIMENSIONS = QUANTITIES.position, QUANTITIES.dimensions
needed_numbers = QUANTITIES.needed_values

EXACT = 1e-6
"""Two numbers of one quantity agree if they differ less: relative, and absolute in mm or rad."""
_COARSEST_ROUNDING = {unit: 0.005 / factor for unit, factor in LENGTH_UNITS.items()} | {
    "rad": 5e-4,
    "deg": 5e-3,
    "": 5e-3,
}
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


def agree(value: object, wanted: float, at_least: float = 0.0) -> bool:
    """Whether a cell's value is the number `wanted`, relative to it and `at_least`."""
    return type(value) is float and abs(value - wanted) <= AGREEING * max(abs(wanted), at_least)
