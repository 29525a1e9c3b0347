"""Storage of volumes for the scene: voxels written to .vdb files; free of bpy, for a job's worker thread."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import Grid, InputError, Volume
from ...core.files import ensure_folder
from ...core.geometry.frames import affine_matrix, checked_affine
from ..blender import compat, ids
from . import vdb, volume_materials

MAX_SHOWN_VOXELS = 256**3
"""The largest number of non-empty voxels that is shown in full; Blender's window would hang on more, so it shows a copy."""


@dataclass(frozen=True)
class StoredVolume:
    """A volume, or the states of one, in world mm, whose voxels are in files, ready to be put into the scene."""

    states: tuple[Volume, ...]
    pose: NDArray[np.float64]  # world from object (4, 4), mm
    path: Path  # the .vdb that Blender shows, of the first state: with every voxel, or a coarser copy
    low: float  # smallest value of all states
    high: float  # largest value of all states
    extent: float  # largest side, mm, of the bounding box of the non-empty voxels

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

    The rigid world-from-object matrix `pose` (4, 4) sets the object's origin and axes; the voxels stay where they are. By
    default, the origin is the middle of the (first) grid and the axes are the world's. The file keeps the `provenance`.
    """
    states = (volume,) if isinstance(volume, Volume) else tuple(volume)
    if len({state.quantity for state in states}) != 1:
        quantities = ", ".join(state.quantity for state in states) or "none"
        raise InputError(f"volume sequence: expected volumes of one quantity, got {quantities}")
    pose = affine_matrix(np.eye(3), states[0].grid.center) if pose is None else checked_affine(pose, "volume pose")
    path = write_states([move_grid(state, np.linalg.inv(pose)) for state in states], folder, provenance)
    low, high = min(float(v.array.min()) for v in states), max(float(v.array.max()) for v in states)
    return StoredVolume(states, pose, path, low, high, max(map(_occupied_extent, states)))


def write_states(states: Sequence[Volume], folder: Path, provenance: dict[str, Any] | None = None) -> Path:
    """Write the states of one volume, such as phases of a beating heart, as .vdb files; return the first file to show.

    Where a state has too many voxels to show, coarser copies of all are written, too, and the first of those is returned.
    `provenance` is stored in the files. Names are made from the content, so that equal volumes share files.
    """
    digest = hashlib.sha256()
    for state in states:
        digest.update(state.array.data)
        grid = state.grid
        content = (grid.shape, grid.affine.tolist(), state.quantity, compat.VDB_CENTER_SHIFT, provenance or {})
        digest.update(json.dumps(content).encode())
    stem = f"{states[0].quantity}-{digest.hexdigest()[:16]}"
    shown_states = list(states)
    while max(np.count_nonzero(state.array != _empty_value(state)) for state in shown_states) > MAX_SHOWN_VOXELS:
        shown_states = [coarsen(state) for state in shown_states]
    low = min(float(state.array.min()) for state in shown_states)
    smoke_above = volume_materials.default_range(states[0].quantity, low, 1.0)[0] if low < 0 else None

    def write(stem: str, states: Sequence[Volume], provenance: Any, smoke_above: float | None) -> Path:
        """Write the states to .vdb files whose names begin with `stem`, and return the first path."""
        ensure_folder(folder)  # a Save As has removed it if it was empty
        paths = [folder / f"{stem}{f'_{k:04d}' if len(states) > 1 else ''}.vdb" for k in range(1, len(states) + 1)]
        for state, path in zip(states, paths, strict=True):
            if not path.exists():
                vdb.write_vdb(state, path, provenance, smoke_above=smoke_above, center_shift=compat.VDB_CENTER_SHIFT)
        return paths[0]

    if shown_states[0] is states[0]:
        return write(stem, states, provenance, smoke_above)
    write(stem, states, provenance, None)
    return write(stem + ids.PREVIEW, shown_states, {"coarser_copy_of": stem}, smoke_above)


def move_grid(volume: Volume, matrix: NDArray[np.float64]) -> Volume:
    """Return a volume with its voxels unchanged and its grid transformed by an affine matrix (4, 4)."""
    return Volume(volume.array, Grid(volume.grid.shape, matrix @ volume.grid.affine), volume.quantity)


def coarsen(volume: Volume) -> Volume:
    """Return the means over blocks of 2^3 voxels, for display; blocks at the edge are completed by empty voxels."""
    padding = [(0, n % 2) for n in volume.grid.shape]
    array = np.pad(volume.array, padding, constant_values=_empty_value(volume))
    a, b, c = (n // 2 for n in array.shape)
    means = array.reshape(a, 2, b, 2, c, 2).mean(axis=(1, 3, 5), dtype=np.float32)
    blocks = affine_matrix(2.0 * np.eye(3), np.full(3, 0.5))  # a block's centre is half a voxel from its first voxel's
    return Volume(means, Grid((a, b, c), volume.grid.affine @ blocks), volume.quantity)


def _empty_value(volume: Volume) -> float:
    """Return the value of voxels that are not drawn."""
    return vdb.BACKGROUND.get(volume.quantity, 0.0)


def _occupied_extent(volume: Volume) -> float:
    """Return the largest side, mm, of the bounding box of the non-empty voxels."""
    filled = volume.array != _empty_value(volume)
    indices = [np.flatnonzero(filled.any(axis=other_axes)) for other_axes in ((1, 2), (0, 2), (0, 1))]
    lengths = [k[-1] - k[0] + 1 if len(k) else 1 for k in indices]
    return float(max(np.multiply(lengths, volume.grid.spacing)))
