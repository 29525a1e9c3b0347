"""Design formulas of a pinhole module: collimator length for an ROI radius, and ROI radius for a collimator length."""

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
    """Return the collimator length l, mm, at which the module's field of view is tangent to the ROI sphere.

    With ``s = (Ld - d) / (2 l)`` tangency means ``b s - d/2 = R sqrt(1 + s^2)``, hence
    ``l = (Ld - d)(b^2 - R^2) / (b d + 2 R sqrt(b^2 - R^2 + d^2/4))``, which is column G of the users' workbook.
    Arguments are numbers, arrays or tensors that broadcast, in mm: b from pinhole centre to isocentre, larger than R; the
    pinhole diameter d; Ld, the side of the square crystal, larger than d; and the ROI's radius R.
    """
    b, d, Ld, R = _check_lengths({"d": "0", "Ld": "d", "R": "0", "b": "R"}, b=b, d=d, Ld=Ld, R=R)
    squared = b**2 - R**2 + d**2 / 4
    return (Ld - d) * (b**2 - R**2) / (b * d + 2 * R * namespace(squared).sqrt(squared))


def roi_radius_seen(
    b: ArrayOrTensor, d: ArrayOrTensor, Ld: ArrayOrTensor, l: ArrayOrTensor, aside: ArrayOrTensor = 0.0
) -> ArrayOrTensor:
    """Return the radius R, mm, of the largest sphere at the isocentre that the module's field of view holds, or 0.

    It is the inverse of `collimator_length`: ``R = (b (Ld - d) - d l) / sqrt(4 l^2 + (Ld - d)^2)``. Every ray from this
    sphere through any point of the hole meets the crystal's front face. Arguments are numbers, arrays or tensors that
    broadcast, in mm: b from pinhole centre to isocentre; the pinhole diameter d; Ld, the crystal's side, larger than d; and
    the collimator length l. For a tilted module, b is the isocentre's height above the pinhole plane, and `aside` the larger
    of its distances from the axis along u and along v: R is less by ``2 l aside / sqrt(4 l^2 + (Ld - d)^2)``.
    """
    b, d, Ld, l = _check_lengths({"d": "0", "Ld": "d", "l": "0", "b": "0"}, b=b, d=d, Ld=Ld, l=l)
    return ((b * (Ld - d) - d * l - 2 * l * aside) / namespace(l).hypot(2 * l, Ld - d)).clip(min=0.0)


def _check_lengths(limits: dict[str, str], **values: ArrayOrTensor) -> list[Any]:
    """Return the `values`, by symbol, as arrays or tensors; raise `InputError` unless all are finite and above their limits.

    `limits` has the lower limit of each: "0", or the symbol of another value.
    """
    refusal = f"{', '.join(values)}: expected real numbers, or arrays of them that broadcast"
    with expecting(refusal, TypeError, ValueError):
        numbers = promote(*(x if is_tensor(x) else np.asarray(x, dtype=np.float64) for x in values.values()))
        np.broadcast_shapes(*(x.shape for x in numbers))
    arrays = {name: x.detach().cpu().numpy() if is_tensor(x) else x for name, x in zip(values, numbers, strict=True)}
    for name, limit in limits.items():
        valid = (arrays[name] > arrays.get(limit, 0.0)) & np.isfinite(arrays[name])
        if not np.all(valid):
            value = np.broadcast_to(arrays[name], np.shape(valid))[~valid].flat[0]
            raise InputError(f"{_NAMES[name]} must be more than {limit} mm, got {value:g}")
    return list(numbers)
