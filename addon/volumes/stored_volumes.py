"""Volumes on their way into the scene: their voxels are written to .vdb files. Leaves bpy alone, for a job's thread."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import Grid, InputError, Volume
from ...core.geometry.frames import affine_matrix, checked_affine
from ..blender import compat, ids
from . import vdb, volume_materials

MAX_SHOWN_VOXELS = 256**3
"""More voxels than this that are not empty are shown as a coarser copy: Blender's window would hang on them."""


@dataclass(frozen=True)
class StoredVolume:
    """A volume, or the states of one, in world mm, whose voxels are in files, ready to be put into the scene."""

    states: tuple[Volume, ...]
    pose: NDArray[np.float64]  # world from object
    path: Path  # the .vdb of the first state that Blender shows: every voxel, or a coarser copy
    low: float  # smallest value
    high: float  # largest value
    extent: float  # largest side, mm, of the box around the voxels that are not empty

    @property
    def volume(self) -> Volume:
        """The first state, or the only one."""
        return self.states[0]


def store_volume(
    volume: Volume | Sequence[Volume],
    folder: Path,
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
) -> StoredVolume:
    """Write the voxels of a volume in world mm, or of states of one quantity, to a folder, for `volumes.add_stored`.

    The rigid world-from-object matrix `pose` (4, 4) says where the object's origin and axes shall be; the voxels stay where
    they are. Default: the origin at the middle of the (first) grid, axes along the world's. The file keeps the `provenance`.
    """
    states = (volume,) if isinstance(volume, Volume) else tuple(volume)
    if len({state.quantity for state in states}) != 1:
        found = ", ".join(state.quantity for state in states) or "none"
        raise InputError(f"volume sequence: expected volumes of one quantity, got {found}")
    place = affine_matrix(np.eye(3), states[0].grid.center) if pose is None else checked_affine(pose, "volume pose")
    path = write_states([moved(state, np.linalg.inv(place)) for state in states], folder, provenance)
    low, high = min(float(v.array.min()) for v in states), max(float(v.array.max()) for v in states)
    return StoredVolume(states, place, path, low, high, max(map(_extent, states)))


def write_states(states: Sequence[Volume], folder: Path, provenance: dict[str, Any] | None = None) -> Path:
    """Write volumes in their object's space, and coarser copies of large ones, under names made from their content.

    Returns the first path to show.
    """
    digest = hashlib.sha256()
    for state in states:
        digest.update(state.array.data)
        grid = state.grid
        made = (grid.shape, grid.affine.tolist(), state.quantity, compat.VDB_CENTER_SHIFT, provenance or {})
        digest.update(json.dumps(made).encode())
    stem = f"{states[0].quantity}-{digest.hexdigest()[:16]}"
    shown = list(states)
    while max(np.count_nonzero(state.array != _empty(state)) for state in shown) > MAX_SHOWN_VOXELS:
        shown = [coarser(state) for state in shown]
    low = min(float(state.array.min()) for state in shown)
    smoke_above = volume_materials.usual_range(states[0].quantity, low, 1.0)[0] if low < 0 else None

    def write(stem: str, states: Sequence[Volume], provenance: Any, smoke_above: float | None) -> Path:
        paths = [folder / f"{stem}{f'_{k:04d}' if len(states) > 1 else ''}.vdb" for k in range(1, len(states) + 1)]
        for state, path in zip(states, paths, strict=True):
            if not path.exists():
                vdb.write_vdb(state, path, provenance, smoke_above=smoke_above, center_shift=compat.VDB_CENTER_SHIFT)
        return paths[0]

    if shown[0] is states[0]:
        return write(stem, states, provenance, smoke_above)
    write(stem, states, provenance, None)
    return write(stem + ids.PREVIEW, shown, {"coarser_copy_of": stem}, smoke_above)


def moved(volume: Volume, matrix: NDArray[np.float64]) -> Volume:
    """The same voxels, their grid moved by an affine matrix (4, 4)."""
    return Volume(volume.array, Grid(volume.grid.shape, matrix @ volume.grid.affine), volume.quantity)


def coarser(volume: Volume) -> Volume:
    """Means over blocks of 2^3 voxels, for display; voxels beyond the edge are empty."""
    padding = [(0, n % 2) for n in volume.grid.shape]
    array = np.pad(volume.array, padding, constant_values=_empty(volume))
    a, b, c = (n // 2 for n in array.shape)
    means = array.reshape(a, 2, b, 2, c, 2).mean(axis=(1, 3, 5), dtype=np.float32)
    blocks = affine_matrix(2.0 * np.eye(3), np.full(3, 0.5))  # the block's middle
    return Volume(means, Grid((a, b, c), volume.grid.affine @ blocks), volume.quantity)


def _empty(volume: Volume) -> float:
    """The value of voxels that are not drawn."""
    return vdb.BACKGROUND.get(volume.quantity, 0.0)


def _extent(volume: Volume) -> float:
    filled = volume.array != _empty(volume)
    used = [np.flatnonzero(filled.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    counts = [k[-1] - k[0] + 1 if len(k) else 1 for k in used]
    return float(max(np.multiply(counts, volume.grid.spacing)))
