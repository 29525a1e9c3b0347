"""Resampling of volumes onto other grids."""

from collections.abc import Callable

import numpy as np

from ..arrays import Floats, Floats32, Integers
from ..errors import InputError
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress
from ..validation import freeze, instance, real_array
from .volume import Volume, outside_value

# For n voxels of the new grid along an axis: indices of the old grid and their weights, (n, taps) each.
_Taps = tuple[Integers, Floats32]

_PARALLEL = 1e-9  # voxels per voxel: axes that deviate by less are parallel
_SLAB = 1 << 20  # samples at once


def resample(
    volume: Volume, grid: Grid, method: str = "linear", outside: float | None = None, progress: Progress | None = None
) -> Volume:
    """Resample `volume` onto `grid`; both may have any affine.

    Parameters
    ----------
    volume, grid
    method
        ``"linear"``: trilinear interpolation between voxel centres. ``"nearest"``: the voxel that holds the new voxel's
        centre (for labels). ``"mean"``: the mean over the new voxel, which keeps the sum of value x volume (for coarser
        grids); it is exact if the grids' axes are parallel, and otherwise the mean of points in the new voxel, at least
        two along each axis and about one for each old voxel.
    outside
        Value outside the old grid. Default: 0, or -1000 for CT numbers.
    progress
        Called as ``progress(done, total)`` between slabs; may raise `Cancelled`.
    """
    if method not in ("linear", "nearest", "mean"):
        raise InputError(f"method {method!r}: expected linear, nearest or mean")
    instance(volume, Volume, "resample")
    instance(grid, Grid, "resample")
    background = np.float32(outside_value(volume) if outside is None else float(real_array(outside, "outside", ())))
    copied = 4 * volume.grid.n_voxels if background else 0
    require(4.5 * grid.n_voxels + copied, "a volume of {} x {} x {} voxels".format(*grid.shape))
    index_from_index = volume.grid.index_from_world @ grid.affine  # index in the old grid from index in the new one
    result = np.empty(grid.shape, np.float32)
    along = np.abs(index_from_index[:3, :3]) > _PARALLEL
    is_parallel = (along.sum(axis=0) == 1).all() and (along.sum(axis=1) == 1).all()  # each new axis to one old axis
    fill = _along_axes if is_parallel else _at_points
    # Outside the array the samples are 0: with the background taken off before, and added after.
    array = volume.array - background if background else volume.array
    fill(array, index_from_index, method, result, progress or (lambda done, total: None))
    result += background
    return Volume(freeze(result), grid, volume.quantity)


def values_at(volume: Volume, points: Floats, method: str = "linear") -> Floats32:
    """Values (N,) at world `points` (N, 3), mm, by the `method` "linear" or "nearest" of `resample`; 0 outside the grid."""
    index = volume.grid.index_from_world
    return _samples(volume.array, index[:3, :3] @ points.T + index[:3, 3:], _TAPS[method])


def _along_axes(array: Floats32, index_from_index: Floats, method: str, result: Floats32, progress: Progress) -> None:
    """Fill `result`, one axis after the other."""
    old_axes = np.abs(index_from_index[:3, :3]).argmax(axis=0)  # the old axis of each new one
    taps = []
    for new, old in enumerate(old_axes):
        at = index_from_index[old, new] * np.arange(result.shape[new]) + index_from_index[old, 3]
        taps.append(_TAPS[method](at, abs(index_from_index[old, new]), array.shape[old]))
    array = array.transpose(old_axes)  # now its axes are the new ones
    plane = max(array.shape[1] * array.shape[2], result.shape[1] * max(array.shape[2], result.shape[2]))
    slab = max(1, _SLAB // plane)
    for first in range(0, result.shape[0], slab):
        part = slice(first, first + slab)
        values = array
        for axis, (index, weight) in enumerate(taps):
            columns = slice(None) if axis else part
            weights = np.expand_dims(weight[columns].T, tuple({1, 2, 3} - {axis + 1}))
            values = sum(np.take(values, i, axis) * w for i, w in zip(index[columns].T, weights, strict=True))
        result[part] = values
        progress(min(first + slab, result.shape[0]), result.shape[0])


def _nearest_taps(at: Floats, step: float, n: int) -> _Taps:
    index = np.floor(at + 0.5).astype(np.int64)
    inside = (index >= 0) & (index < n)
    return index.clip(0, n - 1)[:, None], inside.astype(np.float32)[:, None]


def _linear_taps(at: Floats, step: float, n: int) -> _Taps:
    inside = (at >= -0.5) & (at <= n - 0.5)
    at = at.clip(0, n - 1)
    low = np.floor(at).astype(np.int64)
    share = at - low
    weight = np.stack([1 - share, share], axis=1) * inside[:, None]
    return np.stack([low, np.minimum(low + 1, n - 1)], axis=1), weight.astype(np.float32)


def _mean_taps(at: Floats, step: float, n: int) -> _Taps:
    """Fractions of the new voxel, from ``at - step/2`` to ``at + step/2``, that lie in each old voxel."""
    low, high = at - step / 2 + 0.5, at + step / 2 + 0.5  # voxel i reaches from i to i + 1
    index = np.floor(low).astype(np.int64)[:, None] + np.arange(int(np.ceil(step)) + 1)
    overlap = np.minimum(high[:, None], index + 1) - np.maximum(low[:, None], index)
    weight = np.where((index >= 0) & (index < n), overlap.clip(0) / step, 0)
    return index.clip(0, n - 1), weight.astype(np.float32)


_TAPS = {"nearest": _nearest_taps, "linear": _linear_taps, "mean": _mean_taps}


def _at_points(array: Floats32, index_from_index: Floats, method: str, result: Floats32, progress: Progress) -> None:
    """Fill `result` from sample points: its voxels' centres, or several points in each voxel for means."""
    linear, origin = index_from_index[:3, :3], index_from_index[:3, 3]
    counts = [1, 1, 1]
    if method == "mean":
        counts = [max(2, int(np.ceil(length))) for length in np.abs(linear).max(axis=0)]
    fractions = [(np.arange(count) + 0.5) / count - 0.5 for count in counts]
    shifts = np.stack(np.meshgrid(*fractions, indexing="ij"), axis=-1).reshape(-1, 3) @ linear.T
    taps = _linear_taps if method == "linear" else _nearest_taps
    j, k = np.meshgrid(np.arange(result.shape[1]), np.arange(result.shape[2]), indexing="ij")
    in_plane = linear[:, 1:] @ np.stack([j.ravel(), k.ravel()]) + origin[:, None]
    for i, plane in enumerate(result):
        values = plane.reshape(-1)
        for first in range(0, values.size, _SLAB):
            part = slice(first, first + _SLAB)
            points = in_plane[:, part] + (linear[:, 0] * i)[:, None]
            total = np.zeros(points.shape[1], np.float32)
            for shift in shifts:
                total += _samples(array, points + shift[:, None], taps)
            values[part] = total / len(shifts)
        progress(i + 1, len(result))


def _samples(array: Floats32, points: Floats, taps: Callable[..., _Taps]) -> Floats32:
    """The array at index coordinates `points` (3, N), from the voxels and weights of `taps`; 0 outside."""
    (x, x_weight), (y, y_weight), (z, z_weight) = (
        [part.T.copy() for part in taps(at, 1.0, n)] for at, n in zip(points, array.shape, strict=True)
    )
    total = np.zeros(points.shape[1], np.float32)
    for i, j, k in np.ndindex(len(x), len(y), len(z)):
        total += x_weight[i] * y_weight[j] * z_weight[k] * array[x[i], y[j], z[k]]
    return total
