"""Defaults for pictures of volumes: the positions of slices, and the value of the brightest colour."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_FULL = 0.9  # absolute sum of a full slice, as a fraction of the largest slice's
_BRIGHT_FRACTION = 0.98  # fraction of a volume's sum in voxels that do not exceed the brightest colour's value


def full_slices(values: ArrayLike) -> NDArray[np.int64]:
    """Return, for each axis, the index (3,) of the slice nearest the centre whose absolute sum is 90 % of the largest.

    `values` are voxels (n_x, n_y, n_z).
    """
    array = np.abs(np.asarray(values, np.float64))
    indices = []
    for axis in range(3):
        sums = array.sum(axis=tuple({0, 1, 2} - {axis}))
        full = np.flatnonzero(sums >= _FULL * sums.max())
        indices.append(full[np.abs(full - len(sums) // 2).argmin()])
    return np.array(indices)


def bright_value(values: ArrayLike) -> float:
    """Return the value for the brightest colour: voxels above it hold 2 % of the sum of all positive `values`.

    Single hot voxels of a reconstruction therefore do not darken all others. Returns 0 if no value is above 0.
    """
    positive = np.sort(np.asarray(values, np.float64).ravel())
    positive = positive[positive > 0]
    sums = np.cumsum(positive)
    return float(positive[np.searchsorted(sums, _BRIGHT_FRACTION * sums[-1])]) if len(positive) else 0.0
