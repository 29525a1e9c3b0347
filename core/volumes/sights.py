"""What to look at in a volume: where slices show much of it, and how bright its colours reach."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_NEARLY = 0.9  # of the most that a slice holds
_SHARE = 0.98  # of all that a volume holds is in values that are not brighter than the last colour


def full_slices(values: ArrayLike) -> NDArray[np.int64]:
    """For each axis of values (n_x, n_y, n_z) the index of a slice that holds much: of such, the nearest to the middle."""
    array = np.abs(np.asarray(values, np.float64))
    found = []
    for axis in range(3):
        sums = array.sum(axis=tuple({0, 1, 2} - {axis}))
        full = np.flatnonzero(sums >= _NEARLY * sums.max())
        found.append(full[np.abs(full - len(sums) // 2).argmin()])
    return np.array(found)


def bright_value(values: ArrayLike) -> float:
    """The value that the last colour suits: the voxels that exceed it hold 2 % of all. 0 where no value is above 0.

    So single hot voxels of a reconstruction do not darken all others.
    """
    above = np.sort(np.asarray(values, np.float64).ravel())
    above = above[above > 0]
    held = np.cumsum(above)
    return float(above[np.searchsorted(held, _SHARE * held[-1])]) if len(above) else 0.0
