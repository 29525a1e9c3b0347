"""Resampling of volumes onto other grids, by interpolation or as means."""

from collections.abc import Callable, Iterator

import numpy as np

from ..arrays import Floats, Floats32, Integers
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid, same_grid
from ..memory import require
from ..progress import Progress
from ..validation import freeze, instance, real_array
from .volume import Volume, outside_value

_Stencil = tuple[Integers, Floats32]
"""Interpolation along one axis: indices of the old grid and their weights, each (N, k) for N positions."""

_EDGE = 1e-4  # voxels by which a centre on a box's face may lie outside by rounding
_PARALLEL = 1e-9  # voxels per voxel: axes that deviate by less are parallel
_SLAB = 1 << 20  # samples computed at a time


def resample(
    volume: Volume, grid: Grid, method: str = "linear", outside: float | None = None, progress: Progress | None = None
) -> Volume:
    """Resample `volume` onto `grid`; both may have any affine.

    Parameters
    ----------
    volume
        Volume to resample.
    grid
        Grid of the result.
    method
        ``"linear"``: trilinear interpolation between voxel centres. ``"nearest"``: the value of the voxel that contains
        the new voxel's centre (for labels). ``"mean"``: the mean over the new voxel, which conserves the sum of value x
        volume (for coarser grids). The mean is exact if the grids' axes are parallel; otherwise it is the mean of points
        in the new voxel, at least two along each axis and about one for each old voxel.
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
    copy_bytes = 4 * volume.grid.n_voxels if background else 0
    require(4.5 * grid.n_voxels + copy_bytes, "a volume of {} x {} x {} voxels".format(*grid.shape))
    index_from_index = volume.grid.index_from_world @ grid.affine  # old index from new index
    result = np.empty(grid.shape, np.float32)
    depends = np.abs(index_from_index[:3, :3]) > _PARALLEL
    is_parallel = (depends.sum(axis=0) == 1).all() and (depends.sum(axis=1) == 1).all()  # each new axis to one old axis
    fill = _fill_by_axis if is_parallel else _fill_oblique
    # Samples outside the array are 0: the background is subtracted before and added again afterwards.
    array = volume.array - background if background else volume.array
    fill(array, index_from_index, method, result, progress or (lambda done, total: None))
    result += background
    return Volume(freeze(result), grid, volume.quantity)


def share_outside(volume: Volume, grid: Grid) -> float:
    """Return the share of a volume's sum that is in voxels whose centres are outside the box of `grid`.

    Values are weighed by their difference from those outside of volumes, such as air's CT number. An empty volume gives 0.
    """
    index = grid.index_from_world @ volume.grid.affine  # index in `grid` from the volume's
    low, high, sums = -0.5 - _EDGE, np.array(grid.shape) - 0.5 + _EDGE, np.zeros(2)
    corners = moved(grid.index_from_world, volume.grid.corners())
    if (corners >= low).all() and (corners <= high).all():
        return 0.0
    cells = np.indices(volume.grid.shape[1:]).reshape(2, -1)
    for x, plane in enumerate(volume.array):
        values = np.abs(plane.ravel() - np.float32(outside_value(volume)))
        centres = index[:3, 1:3] @ cells + index[:3, :1] * x + index[:3, 3:]
        is_outside = ((centres < low) | (centres > high[:, None])).any(axis=0)
        sums += values.sum(dtype=float), values[is_outside].sum(dtype=float)
    return float(sums[1] / sums[0]) if sums[0] else 0.0


def outside_warnings(volume: Volume, grid: Grid, place: str, effect: str, limit: float = 0.01) -> Iterator[str]:
    """Yield a warning if more than the share `limit` of a volume is outside the box of `grid`.

    `place` is what the grid is of, and `effect` what becomes of the values outside it.
    """
    if not same_grid(volume.grid, grid) and (share := share_outside(volume, grid)) > limit:
        yield f"{100 * share:.3g} % of the {volume.quantity} lies outside {place}, {effect}: check where both lie"


def values_at(volume: Volume, points: Floats, method: str = "linear") -> Floats32:
    """Return the volume's values (N,) at world `points` (N, 3), mm; 0 outside the grid.

    `method` is "linear" or "nearest", as for `resample`.
    """
    index_from_world = volume.grid.index_from_world
    return _sample(volume.array, index_from_world[:3, :3] @ points.T + index_from_world[:3, 3:], _STENCILS[method])


def _fill_by_axis(array: Floats32, index_from_index: Floats, method: str, result: Floats32, progress: Progress) -> None:
    """Fill `result` by interpolation of `array` along one axis after the other, for grids with parallel axes."""
    old_axes = np.abs(index_from_index[:3, :3]).argmax(axis=0)  # the old axis of each new axis
    stencils = []
    for new, old in enumerate(old_axes):
        position = index_from_index[old, new] * np.arange(result.shape[new]) + index_from_index[old, 3]
        stencils.append(_STENCILS[method](position, abs(index_from_index[old, new]), array.shape[old]))
    array = array.transpose(old_axes)  # in the order of the new axes
    plane = max(array.shape[1] * array.shape[2], result.shape[1] * max(array.shape[2], result.shape[2]))
    slab = max(1, _SLAB // plane)
    for first in range(0, result.shape[0], slab):
        block = slice(first, first + slab)
        values = array
        for axis, (index, weight) in enumerate(stencils):
            rows = slice(None) if axis else block
            weights = np.expand_dims(weight[rows].T, tuple({1, 2, 3} - {axis + 1}))
            values = sum(np.take(values, i, axis) * w for i, w in zip(index[rows].T, weights, strict=True))
        result[block] = values
        progress(min(first + slab, result.shape[0]), result.shape[0])


# Stencils for positions (N,) along an axis of n voxels, in its voxel indices; `step` is the width of the new voxels in them.


def _nearest_stencil(position: Floats, step: float, n: int) -> _Stencil:
    """Return the voxel that contains each position, with weight 1; 0 outside the grid."""
    index = np.floor(np.round(position, 6) + 0.5).astype(np.int64)  # of centres on faces, rounding chooses no side
    inside = (index >= 0) & (index < n)
    return index.clip(0, n - 1)[:, None], inside.astype(np.float32)[:, None]


def _linear_stencil(position: Floats, step: float, n: int) -> _Stencil:
    """Return the two voxels around each position, with the weights of linear interpolation; 0 outside the grid."""
    inside = (position >= -0.5) & (position <= n - 0.5)
    position = position.clip(0, n - 1)
    low = np.floor(position).astype(np.int64)
    fraction = position - low
    weight = np.stack([1 - fraction, fraction], axis=1) * inside[:, None]
    return np.stack([low, np.minimum(low + 1, n - 1)], axis=1), weight.astype(np.float32)


def _mean_stencil(position: Floats, step: float, n: int) -> _Stencil:
    """Return the old voxels under each new voxel, from ``position - step/2`` to ``+ step/2``, with their fractions of it."""
    low, high = position - step / 2 + 0.5, position + step / 2 + 0.5  # here voxel i extends from i to i + 1
    index = np.floor(low).astype(np.int64)[:, None] + np.arange(int(np.ceil(step)) + 1)
    overlap = np.minimum(high[:, None], index + 1) - np.maximum(low[:, None], index)
    weight = np.where((index >= 0) & (index < n), overlap.clip(0) / step, 0)
    return index.clip(0, n - 1), weight.astype(np.float32)


_STENCILS = {"nearest": _nearest_stencil, "linear": _linear_stencil, "mean": _mean_stencil}


def _fill_oblique(array: Floats32, index_from_index: Floats, method: str, result: Floats32, progress: Progress) -> None:
    """Fill `result` from samples of `array` at its voxels' centres, or for means at several points in each voxel."""
    linear, origin = index_from_index[:3, :3], index_from_index[:3, 3]
    counts = [1, 1, 1]
    if method == "mean":
        counts = [max(2, int(np.ceil(length))) for length in np.abs(linear).max(axis=0)]
    offsets = [(np.arange(count) + 0.5) / count - 0.5 for count in counts]
    shifts = np.stack(np.meshgrid(*offsets, indexing="ij"), axis=-1).reshape(-1, 3) @ linear.T
    stencil = _linear_stencil if method == "linear" else _nearest_stencil
    j, k = np.meshgrid(np.arange(result.shape[1]), np.arange(result.shape[2]), indexing="ij")
    plane_points = linear[:, 1:] @ np.stack([j.ravel(), k.ravel()]) + origin[:, None]
    for i, plane in enumerate(result):
        values = plane.reshape(-1)
        for first in range(0, values.size, _SLAB):
            block = slice(first, first + _SLAB)
            points = plane_points[:, block] + (linear[:, 0] * i)[:, None]
            total = np.zeros(points.shape[1], np.float32)
            for shift in shifts:
                total += _sample(array, points + shift[:, None], stencil)
            values[block] = total / len(shifts)
        progress(i + 1, len(result))


def _sample(array: Floats32, points: Floats, stencil: Callable[..., _Stencil]) -> Floats32:
    """Return the values (N,) of `array` at index coordinates `points` (3, N), interpolated by `stencil`; 0 outside."""
    (x, x_weight), (y, y_weight), (z, z_weight) = (
        [part.T.copy() for part in stencil(row, 1.0, n)] for row, n in zip(points, array.shape, strict=True)
    )
    total = np.zeros(points.shape[1], np.float32)
    for i, j, k in np.ndindex(len(x), len(y), len(z)):
        total += x_weight[i] * y_weight[j] * z_weight[k] * array[x[i], y[j], z[k]]
    return total
