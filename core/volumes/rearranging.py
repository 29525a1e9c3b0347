"""Rearrangement of volumes without interpolation: crop, pad, reorient, move, and split by labels."""

import numpy as np

from ..arrays import Array, ArrayLike, Floats32, Integers
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid, same_grid
from ..memory import require
from ..validation import freeze, instance, one_for_all, real_array, real_numbers, shape_text
from .volume import Volume, outside_value


def crop(volume: Volume, start: ArrayLike, stop: ArrayLike) -> Volume:
    """Return the voxels from index `start` (3,) up to, but without, `stop` (3,); they stay where they are in the world."""
    instance(volume, Volume, "crop")
    low, high = _indices(start, "crop start"), _indices(stop, "crop stop")
    array = volume.array
    if np.any(low < 0) or np.any(high > array.shape) or np.any(low >= high):
        raise InputError(f"crop: from {low.tolist()} to {high.tolist()} is no part of {shape_text(array.shape)} voxels")
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    return _shifted_volume(volume, array[box], low)


def crop_to_box(volume: Volume, low: ArrayLike, high: ArrayLike) -> Volume:
    """Return the smallest block of voxels that contains the volume's part in the box from `low` to `high` (3,), world mm."""
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
    """Return the volume with `before` (3,) more voxels at the start and `after` (3,) at the end of each index axis.

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
    return _shifted_volume(volume, array, -low)


def canonical(volume: Volume) -> Volume:
    """Return the volume with its index axes flipped and transposed to be closest to right, front and head (RAS)."""
    from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation

    instance(volume, Volume, "canonical")
    orientation = io_orientation(volume.grid.affine)
    array = apply_orientation(volume.array, orientation)
    grid = Grid(array.shape, volume.grid.affine @ inv_ornt_aff(orientation, volume.grid.shape))
    return Volume(freeze(np.array(array, order="C")), grid, volume.quantity)


def centered(volume: Volume, point: ArrayLike = (0.0, 0.0, 0.0)) -> Volume:
    """Return the volume moved so that its centre is at `point` (3,), world mm."""
    instance(volume, Volume, "centered")
    affine = volume.grid.affine.copy()
    affine[:3, 3] += real_array(point, "point", (3,)) - volume.grid.center
    return Volume(volume.array, Grid(volume.grid.shape, affine), volume.quantity)


def split_labels(volume: Volume, labels: Volume | Array) -> dict[int, Volume]:
    """Return one volume per label, by label: the values of the voxels with that label, elsewhere 0 (CT numbers: -1000).

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
        expected = f"{shape_text(volume.grid.shape)} whole numbers"
        raise InputError(f"labels: expected {expected}, got {array.dtype} of shape {array.shape}")
    unique = np.unique(array)
    if not (unique == np.floor(unique)).all():
        raise InputError(f"labels: expected whole numbers, got {unique[unique != np.floor(unique)][0]:g}")
    require(4.0 * array.size * len(unique), f"a volume for each of {len(unique)} labels")
    background = np.float32(outside_value(volume))
    return {
        int(label): Volume(freeze(np.where(array == label, volume.array, background)), volume.grid, volume.quantity)
        for label in unique
    }


def _indices(value: ArrayLike, name: str) -> Integers:
    """Return `value`, one number for all axes or one per axis, as whole numbers (3,), or raise `InputError`."""
    numbers = one_for_all(value, name, 3)
    if not (numbers == np.floor(numbers)).all():
        raise InputError(f"{name}: expected whole numbers of voxels, got {numbers.tolist()}")
    return numbers.astype(np.int64)


def _shifted_volume(volume: Volume, array: Floats32, start: Integers) -> Volume:
    """Return `array` as a volume on the lattice of `volume`, in which its first voxel has the index `start` (3,)."""
    return Volume(array, volume.grid.box(start, array.shape), volume.quantity)
