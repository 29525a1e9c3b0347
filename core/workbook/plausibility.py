"""The sheet's numbers against the formulas, and against what scanners are like."""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.typing import NDArray

from ..errors import InputWarning
from ..geometry.design_formulas import collimator_length
from ..geometry.system import PinholeSystem
from .layout import Column
from .quantities import QUANTITIES, tolerance

AGREEING = 1e-9
"""Relative: a formula's result nearer to a number than this gives that number."""
SHOWN = 5
"""Warnings of one column; the last one counts the rest."""


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
    column: Column,
    given: NDArray[np.float64],
    expected: NDArray[np.float64],
    slack: NDArray[np.float64] | float = 0.0,
) -> None:
    """Warn of each module whose number in the sheet differs from the formula's.

    Parameters
    ----------
    column
        Where the numbers stand.
    given
        (M,) in the column's unit, NaN where there is none.
    expected
        (M,) mm or rad.
    slack
        mm; added to the tolerance: what rounding of the numbers behind `expected` may make of it.
    """
    name, unit = column.quantity, column.unit
    expected, slack = expected / column.factor, np.broadcast_to(slack, given.shape) / column.factor
    difference = np.abs(given - expected)
    if QUANTITIES[name].kind == "angle":
        turn = 2 * math.pi / column.factor
        difference = np.abs((given - expected + turn / 2) % turn - turn / 2)
    differing = [
        i
        for i in np.flatnonzero(np.isfinite(given))
        if difference[i] > tolerance(given[i], expected[i], unit) + slack[i]
    ]
    for n, i in enumerate(differing[:SHOWN], start=1):
        more = f"; so do {len(differing) - SHOWN} more cells of this column" if n == SHOWN < len(differing) else ""
        used = "the sheet's is used" if name == "l" else "the formula's is used"
        warnings.warn(
            f"{column.where(int(i))} has {name} = {given[i]:.9g} {unit}, "
            f"the formula gives {expected[i]:.9g} {unit} ({used}{more})",
            InputWarning,
            stacklevel=4,
        )


def warn_of_implausible(name: str, values: NDArray[np.float64], column: Column) -> None:
    """Warn of the first module of which a length (M,), mm, that comes from `column` is unlike any scanner's."""
    low, high = QUANTITIES[name].plausible
    odd = np.flatnonzero((values < low) | (values > high))
    if len(odd):
        several = len(set(column.rows)) > 1 and len(odd) > 1
        more = f" (so it is for {len(odd) - 1} more modules)" if several else ""
        warnings.warn(
            f"{column.where(int(odd[0]))} makes {name} = {values[odd[0]]:.6g} mm{more}, which is unlikely, expected "
            f"{low:g} to {high:g} mm: are the units right?",
            InputWarning,
            stacklevel=4,
        )
