"""Design formulas of a pinhole module."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

Array = NDArray[np.float64]

_NAMES = {
    "b": "b, the distance from pinhole to isocentre,",
    "d": "d, the pinhole diameter,",
    "l": "l, the collimator length,",
    "Ld": "Ld, the crystal's side,",
    "R": "R, the ROI radius,",
}


def collimator_length(b: ArrayLike, d: ArrayLike, Ld: ArrayLike, R: ArrayLike) -> Array:
    """Collimator length l, mm, at which the module's field of view is tangent to the ROI sphere.

    With ``s = (Ld - d) / (2 l)`` tangency means ``b s - d/2 = R sqrt(1 + s^2)``, hence
    ``l = (Ld - d)(b^2 - R^2) / (b d + 2 R sqrt(b^2 - R^2 + d^2/4))``, which is column G of the users' workbook.

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
        l, mm, of the broadcast shape.

    Raises
    ------
    InputError
        A number is not finite or out of range, or the shapes do not broadcast.
    """
    b, d, Ld, R = _numbers(b=b, d=d, Ld=Ld, R=R)
    _require("d", d, d > 0, "more than 0")
    _require("Ld", Ld, Ld > d, "more than d")
    _require("R", R, R > 0, "more than 0")
    _require("b", b, b > R, "more than R")
    return (Ld - d) * (b**2 - R**2) / (b * d + 2 * R * np.sqrt(b**2 - R**2 + d**2 / 4))


def roi_radius_seen(b: ArrayLike, d: ArrayLike, Ld: ArrayLike, l: ArrayLike) -> Array:
    """Radius R, mm, of the largest sphere at the isocentre that the module's field of view holds, or 0.

    The inverse of `collimator_length`: ``R = (b (Ld - d) - d l) / sqrt(4 l^2 + (Ld - d)^2)``. Every ray from this sphere
    through any point of the hole meets the crystal's front face. Parameters and errors are as there, with the collimator
    length l, mm.
    """
    b, d, Ld, l = _numbers(b=b, d=d, Ld=Ld, l=l)
    _require("d", d, d > 0, "more than 0")
    _require("Ld", Ld, Ld > d, "more than d")
    _require("l", l, l > 0, "more than 0")
    _require("b", b, b > 0, "more than 0")
    return np.maximum((b * (Ld - d) - d * l) / np.hypot(2 * l, Ld - d), 0.0)


def _numbers(**given: ArrayLike) -> list[Array]:
    try:
        arrays = [np.asarray(x, dtype=np.float64) for x in given.values()]
        np.broadcast_shapes(*(array.shape for array in arrays))
    except (TypeError, ValueError):
        raise InputError(f"{', '.join(given)}: expected real numbers, or arrays of them that broadcast") from None
    return arrays


def _require(name: str, value: Array, good: NDArray[np.bool_], need: str) -> None:
    good = good & np.isfinite(value)
    if not np.all(good):
        found = np.broadcast_to(value, np.shape(good))[~good].flat[0]
        raise InputError(f"{_NAMES[name]} must be {need} mm, got {found:g}")
