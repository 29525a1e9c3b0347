"""Design formulas of a pinhole module."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError


def collimator_length(b: ArrayLike, d: ArrayLike, Ld: ArrayLike, R: ArrayLike) -> NDArray[np.float64]:
    """Collimator length l, mm, at which the module's field of view is tangent to the ROI sphere.

    With ``s = (Ld - d) / (2 l)`` tangency means ``b s - d/2 = R sqrt(1 + s^2)``, hence
    ``l = (Ld - d)(b^2 - R^2) / (b d + 2 R sqrt(b^2 - R^2 + d^2/4))``: column G of the users' workbook.

    Parameters
    ----------
    b
        Pinhole centre to isocentre, mm, larger than R.
    d
        Pinhole diameter, mm.
    Ld
        Side of the square detector crystal, mm, larger than d.
    R
        ROI radius, mm.

    Returns
    -------
    array
        l, mm, of the arguments' common (broadcast) shape.

    Raises
    ------
    InputError
        A number is not finite or out of its range.
    """
    b, d, Ld, R = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in (b, d, Ld, R)))
    for name, value, good in (
        ("d, the pinhole diameter,", d, d > 0),
        ("Ld, the crystal's side,", Ld, Ld > d),
        ("R, the ROI radius,", R, R > 0),
        ("b, the distance from pinhole to isocentre,", b, b > R),
    ):
        good = good & np.isfinite(value)
        if not good.all():
            need = {"d": "more than 0", "L": "more than d", "R": "more than 0", "b": "more than R"}[name[0]]
            raise InputError(f"{name} must be {need} mm, got {value[~good].flat[0]:g}")
    return (Ld - d) * (b**2 - R**2) / (b * d + 2 * R * np.sqrt(b**2 - R**2 + d**2 / 4))
