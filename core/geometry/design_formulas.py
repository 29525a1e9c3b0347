"""Design formulas of a pinhole module."""

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
    Arguments are in mm and broadcast: b from pinhole centre to isocentre, larger than R; d of the pinhole; Ld, the side of
    the square crystal, larger than d; and the ROI's radius R.
    """
    b, d, Ld, R = _numbers({"d": "0", "Ld": "d", "R": "0", "b": "R"}, b=b, d=d, Ld=Ld, R=R)
    return (Ld - d) * (b**2 - R**2) / (b * d + 2 * R * np.sqrt(b**2 - R**2 + d**2 / 4))


def roi_radius_seen(b: ArrayLike, d: ArrayLike, Ld: ArrayLike, l: ArrayLike) -> Array:
    """Radius R, mm, of the largest sphere at the isocentre that the module's field of view holds, or 0.

    The inverse of `collimator_length`: ``R = (b (Ld - d) - d l) / sqrt(4 l^2 + (Ld - d)^2)``. Every ray from this sphere
    through any point of the hole meets the crystal's front face. Arguments are as there, with the collimator length l, mm.
    """
    b, d, Ld, l = _numbers({"d": "0", "Ld": "d", "l": "0", "b": "0"}, b=b, d=d, Ld=Ld, l=l)
    return np.maximum((b * (Ld - d) - d * l) / np.hypot(2 * l, Ld - d), 0.0)


def _numbers(limits: dict[str, str], **given: ArrayLike) -> list[Array]:
    """The arguments as arrays; each must be finite and more than its limit, which is 0 or another argument."""
    try:
        arrays = {name: np.asarray(x, dtype=np.float64) for name, x in given.items()}
        np.broadcast_shapes(*(array.shape for array in arrays.values()))
    except (TypeError, ValueError):
        raise InputError(f"{', '.join(given)}: expected real numbers, or arrays of them that broadcast") from None
    for name, limit in limits.items():
        good = (arrays[name] > arrays.get(limit, 0.0)) & np.isfinite(arrays[name])
        if not np.all(good):
            found = np.broadcast_to(arrays[name], np.shape(good))[~good].flat[0]
            raise InputError(f"{_NAMES[name]} must be more than {limit} mm, got {found:g}")
    return list(arrays.values())
