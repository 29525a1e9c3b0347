"""Design formulas of a pinhole module."""

from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, is_tensor, namespace, promote
from ..errors import InputError, expecting

_NAMES = {
    "b": "b, the distance from pinhole to isocentre,",
    "d": "d, the pinhole diameter,",
    "l": "l, the collimator length,",
    "Ld": "Ld, the crystal's side,",
    "R": "R, the ROI radius,",
}


def collimator_length(b: ArrayOrTensor, d: ArrayOrTensor, Ld: ArrayOrTensor, R: ArrayOrTensor) -> ArrayOrTensor:
    """Collimator length l, mm, at which the module's field of view is tangent to the ROI sphere.

    With ``s = (Ld - d) / (2 l)`` tangency means ``b s - d/2 = R sqrt(1 + s^2)``, hence
    ``l = (Ld - d)(b^2 - R^2) / (b d + 2 R sqrt(b^2 - R^2 + d^2/4))``, which is column G of the users' workbook.
    Arguments are numbers, arrays or tensors that broadcast, in mm: b from pinhole centre to isocentre, larger than R; d of
    the pinhole; Ld, the side of the square crystal, larger than d; and the ROI's radius R.
    """
    b, d, Ld, R = _numbers({"d": "0", "Ld": "d", "R": "0", "b": "R"}, b=b, d=d, Ld=Ld, R=R)
    squared = b**2 - R**2 + d**2 / 4
    return (Ld - d) * (b**2 - R**2) / (b * d + 2 * R * namespace(squared).sqrt(squared))


def roi_radius_seen(
    b: ArrayOrTensor, d: ArrayOrTensor, Ld: ArrayOrTensor, l: ArrayOrTensor, aside: ArrayOrTensor = 0.0
) -> ArrayOrTensor:
    """Radius R, mm, of the largest sphere at the isocentre that the module's field of view holds, or 0.

    The inverse of `collimator_length`: ``R = (b (Ld - d) - d l) / sqrt(4 l^2 + (Ld - d)^2)``. Every ray from this sphere
    through any point of the hole meets the crystal's front face. Arguments are as there, with the collimator length l, mm.
    Of a tilted module, b is the isocentre's height above the pinhole plane, and `aside` its distance from the axis along u
    or along v, whichever is more, mm: ``R`` is less by ``2 l aside / sqrt(4 l^2 + (Ld - d)^2)``.
    """
    b, d, Ld, l = _numbers({"d": "0", "Ld": "d", "l": "0", "b": "0"}, b=b, d=d, Ld=Ld, l=l)
    return ((b * (Ld - d) - d * l - 2 * l * aside) / namespace(l).hypot(2 * l, Ld - d)).clip(min=0.0)


def _numbers(limits: dict[str, str], **given: ArrayOrTensor) -> list[Any]:
    """The arguments as arrays or tensors; each must be finite and more than its limit, which is 0 or another argument."""
    refusal = f"{', '.join(given)}: expected real numbers, or arrays of them that broadcast"
    with expecting(refusal, TypeError, ValueError):
        numbers = promote(*(x if is_tensor(x) else np.asarray(x, dtype=np.float64) for x in given.values()))
        np.broadcast_shapes(*(x.shape for x in numbers))
    arrays = {name: x.detach().cpu().numpy() if is_tensor(x) else x for name, x in zip(given, numbers, strict=True)}
    for name, limit in limits.items():
        good = (arrays[name] > arrays.get(limit, 0.0)) & np.isfinite(arrays[name])
        if not np.all(good):
            found = np.broadcast_to(arrays[name], np.shape(good))[~good].flat[0]
            raise InputError(f"{_NAMES[name]} must be more than {limit} mm, got {found:g}")
    return list(numbers)
