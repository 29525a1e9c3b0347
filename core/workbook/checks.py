"""The sheet's derived numbers (b, l, H, x2 .. z2, range, azimuth, elevation) against the formulas."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..design import collimator_length
from ..errors import InputWarning
from ..system import PinholeSystem

EXACT = 1e-6
"""Relative, and absolute in mm or radians: stored results of formulas agree far better."""
COARSEST_DECIMALS = {"mm": 2, "rad": 3, "deg": 2}
"""A number may be rounded in its last decimal; rounded to fewer decimals than these it is another number."""
AGREEING = 1e-9
"""Relative: a formula's result nearer to a number than this gives that number."""
SHOWN = 5
"""Warnings of one column; the last one counts the rest."""

_UNITS = {"azimuth": "rad", "elevation": "rad"}


def tolerance(value: float, expected: float, unit: str) -> float:
    """By how much `value` may differ from `expected`: `EXACT`, or half a unit of its last decimal."""
    text = f"{value:.12g}"
    decimals = len(text.partition(".")[2]) if "e" not in text else 12
    # Trailing zeros are lost: 89.1 may be 89.10, so few decimals stand for the coarsest rounding.
    rounding = 0.5 * 10.0 ** -max(decimals, COARSEST_DECIMALS[unit])
    return max(EXACT * max(1.0, abs(expected)), rounding * (1 + 1e-9))


def is_by_design(system: PinholeSystem) -> NDArray[np.bool_]:
    """Which modules (M,) have the design formula's collimator length."""
    length = collimator_length(
        system.pinhole_distance, system.pinhole_diameter, system.detector_side, system.roi_radius
    )
    return np.abs(length - system.collimator_length) <= AGREEING * system.collimator_length


def derived(
    centers: NDArray[np.float64],
    collimator_length: NDArray[np.float64],
    detector_thickness: NDArray[np.float64],
) -> dict[str, NDArray[np.float64]]:
    """What the sheet's derived columns should hold, mm and radians, of pinholes (M, 3) with l and Td (M,)."""
    x, y, z = centers.T
    b = np.linalg.norm(centers, axis=1)
    end = b + collimator_length + detector_thickness
    x2, y2, z2 = (centers * (end / b)[:, None]).T
    planar = np.hypot(x, y)
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, planar)
    return {
        "b": b,
        "H": end,
        "x2": x2,
        "y2": y2,
        "z2": z2,
        "range": planar,
        "azimuth": azimuth,
        "elevation": elevation,
    }


def warn_of_differences(
    quantity: str,
    given: NDArray[np.float64],
    expected: NDArray[np.float64],
    place: Callable[[int], str],
    *,
    degrees: bool = False,
    slack: NDArray[np.float64] | float = 0.0,
) -> None:
    """Warn of each module whose `given` number (M,), NaN where there is none, differs from `expected` (M,).

    Parameters
    ----------
    place
        Module index -> file, sheet and cell.
    degrees
        Whether `given` is an angle in degrees.
    slack
        Added to the tolerance: what rounding of the numbers behind `expected` may make of it.
    """
    unit = "deg" if degrees else _UNITS.get(quantity, "mm")
    expected = np.degrees(expected) if degrees else expected
    difference = np.abs(given - expected)
    if unit != "mm":
        turn = 360.0 if degrees else 2 * math.pi
        difference = np.abs((given - expected + turn / 2) % turn - turn / 2)
    slack = np.broadcast_to(slack, given.shape)
    differing = [
        i
        for i in np.flatnonzero(np.isfinite(given))
        if difference[i] > tolerance(given[i], expected[i], unit) + slack[i]
    ]
    for n, i in enumerate(differing[:SHOWN], start=1):
        more = f"; so do {len(differing) - SHOWN} more cells of this column" if n == SHOWN < len(differing) else ""
        used = "the sheet's is used" if quantity == "l" else "the formula's is used"
        warnings.warn(
            f"{place(int(i))} has {quantity} = {given[i]:.9g} {unit}, "
            f"the formula gives {expected[i]:.9g} {unit} ({used}{more})",
            InputWarning,
            stacklevel=3,
        )
