"""Changes that keep the voxels' values: crop, pad, reorient, move, and split by labels."""

import numpy as np

from ..arrays import Array, ArrayLike, Floats32, Integers
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid, same_grid
from ..memory import require
from ..validation import freeze, instance, one_for_all, real_array, real_numbers
from .volume import Volume, outside_value


def crop(volume: Volume, start: ArrayLike, stop: ArrayLike) -> Volume:
    """The part from index `start` (3,) up to, but without, `stop` (3,); its place in the world stays the same."""
    instance(volume, Volume, "crop")
    low, high = _indices(start, "crop start"), _indices(stop, "crop stop")
    shape = np.array(volume.grid.shape)
    if np.any(low < 0) or np.any(high > shape) or np.any(low >= high):
        whole = " x ".join(map(str, shape))
        raise InputError(f"crop: from {low.tolist()} to {high.tolist()} is no part of {whole} voxels")
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    return _part(volume, volume.array[part], low)


def crop_to_box(volume: Volume, low: ArrayLike, high: ArrayLike) -> Volume:
    """The smallest part that holds all of the volume inside the box from `low` (3,) to `high` (3,), world mm."""
    instance(volume, Volume, "crop_to_box")
    low, high = real_array(low, "box", (3,)), real_array(high, "box", (3,))
    if np.any(low >= high):
        raise InputError(f"box: expected low below high, got {low.tolist()} to {high.tolist()} mm")
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    index = moved(volume.grid.index_from_world, corners)
    # A box that only touches a voxel's face, up to rounding, does not include the voxel.
    start = np.clip(np.floor(index.min(axis=0) + 0.5 + 1e-6), 0, volume.grid.shape).astype(int)
    stop = np.clip(np.ceil(index.max(axis=0) + 0.5 - 1e-6), 0, volume.grid.shape).astype(int)
    if np.any(start >= stop):
        raise InputError(f"box from {low.tolist()} to {high.tolist()} mm: the volume is not in it")
    return crop(volume, start, stop)


def pad(volume: Volume, before: ArrayLike, after: ArrayLike, value: float | None = None) -> Volume:
    """The volume with `before` (3,) more voxels at the front and `after` (3,) at the back of each index axis.

    One number stands for all axes. `value` fills the new voxels; default 0, or -1000 for CT numbers.
    """
    instance(volume, Volume, "pad")
    low, high = _indices(before, "pad before"), _indices(after, "pad after")
    if np.any(low < 0) or np.any(high < 0):
        raise InputError("pad: expected whole numbers of voxels of at least 0")
    value = outside_value(volume) if value is None else float(real_array(value, "pad value", ()))
    shape = np.array(volume.grid.shape) + low + high
    require(4.0 * float(np.prod(shape, dtype=float)), "a volume of {} x {} x {} voxels".format(*shape))
    array = np.full(shape, value, np.float32)
    array[tuple(slice(a, a + n) for a, n in zip(low, volume.grid.shape, strict=True))] = volume.array
    return _part(volume, array, -low)


def canonical(volume: Volume) -> Volume:
    """The volume flipped and transposed so that its index axes are closest to right, front and head (RAS)."""
    from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation

    instance(volume, Volume, "canonical")
    turns = io_orientation(volume.grid.affine)
    array = apply_orientation(volume.array, turns)
    grid = Grid(array.shape, volume.grid.affine @ inv_ornt_aff(turns, volume.grid.shape))
    return Volume(freeze(np.array(array, order="C")), grid, volume.quantity)


def centered(volume: Volume, point: ArrayLike = (0.0, 0.0, 0.0)) -> Volume:
    """The volume, moved so that its middle is at `point` (3,), world mm."""
    instance(volume, Volume, "centered")
    affine = volume.grid.affine.copy()
    affine[:3, 3] += real_array(point, "point", (3,)) - volume.grid.center
    return Volume(volume.array, Grid(volume.grid.shape, affine), volume.quantity)


def split_labels(volume: Volume, labels: Volume | Array) -> dict[int, Volume]:
    """One volume for each label, with the values where `labels` has that label, and elsewhere 0, or -1000 for CT numbers.

    `labels` are whole numbers: a volume on the same grid, or an array of its shape. Label 0, usually the background, is
    included.
    """
    instance(volume, Volume, "split_labels")
    if isinstance(labels, Volume):
        if not same_grid(labels.grid, volume.grid):
            raise InputError("labels: expected the volume's own grid; resample them onto it, method 'nearest'")
        labels = labels.array
    array = real_numbers(labels, "labels")
    if array.shape != volume.grid.shape:
        expected = " x ".join(map(str, volume.grid.shape))
        raise InputError(f"labels: expected {expected} whole numbers, got {array.dtype} of shape {array.shape}")
    found = np.unique(array)
    if not (found == np.floor(found)).all():
        raise InputError(f"labels: expected whole numbers, got {found[found != np.floor(found)][0]:g}")
    require(4.0 * array.size * len(found), f"a volume for each of {len(found)} labels")
    background = np.float32(outside_value(volume))
    return {
        int(label): Volume(freeze(np.where(array == label, volume.array, background)), volume.grid, volume.quantity)
        for label in found
    }


def _indices(value: ArrayLike, name: str) -> Integers:
    numbers = one_for_all(value, name, 3)
    if not (numbers == np.floor(numbers)).all():
        raise InputError(f"{name}: expected whole numbers of voxels, got {numbers.tolist()}")
    return numbers.astype(np.int64)


def _part(volume: Volume, array: Floats32, start: Integers) -> Volume:
    """`array` as a volume whose first voxel has the index `start` in `volume`."""
    return Volume(array, volume.grid.box(start, array.shape), volume.quantity)
