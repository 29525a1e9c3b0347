"""Closed meshes to volumes: the share of every voxel that lies inside, exactly.

The triangles are cut along all planes between voxels. Each piece then bounds a prism that reaches from it to the end of
its column of voxels: of the piece's own voxel it takes a part that is known exactly, of the further ones the piece's area.
Summed with the sign of the side that the piece looks to, the prisms give the mean winding number of each voxel (the
divergence theorem), which is the covered share wherever the mesh does not cut through itself.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import freeze, real_array
from ..errors import InputError
from ..grid import Grid
from ..memory import require
from ..progress import Progress
from ..volume import Volume
from .mesh import Mesh, as_mesh, require_closed

_COLUMNS = 1 << 16  # of voxels, at once
_ROUNDING = 1e-9  # shares closer than this to 0 and 1 are that


def voxelize_mesh(
    mesh: Any,
    grid: Grid,
    value: ArrayLike = 1.0,
    quantity: str = "activity",
    progress: Progress | None = None,
) -> Volume:
    """The volume of one closed mesh, or of several.

    Parameters
    ----------
    mesh
        A `Mesh`, a trimesh mesh or scene, ``(vertices (V, 3), faces (F, 3))`` in world mm, or the path of a file (see
        `read_mesh`); or a list of these, of which later ones replace what they cover of earlier ones.
    grid
        Where the voxels are; any affine. What of the mesh lies beside it is left out.
    value
        Inside, in the quantity's unit: one number, or one for each mesh. 0 outside.
    quantity
        What the values are.
    progress
        Called as ``progress(done, total)`` between slabs; may raise `Cancelled`.

    Raises
    ------
    InputError
        A mesh is open or its faces look to different sides, and where; or it is no mesh.
    """
    several = isinstance(mesh, Sequence) and not isinstance(mesh, str) and not _is_pair(mesh)
    meshes = [as_mesh(one) for one in (mesh if several else [mesh])]
    if not meshes:
        raise InputError("voxelize_mesh: expected at least one mesh")
    values = real_array(np.broadcast_to(value, len(meshes)) if np.ndim(value) == 0 else value, "value", (len(meshes),))
    require(8.5 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    array = np.zeros(grid.shape, np.float32)
    for i, (one, inside) in enumerate(zip(meshes, values, strict=True)):

        def report(done: int, total: int, i: int = i) -> None:
            if progress is not None:
                progress(i * total + done, len(meshes) * total)

        covered = mesh_coverage(one, grid, report)
        array += covered * (np.float32(inside) - array)
    return Volume(freeze(array), grid, quantity)


def mesh_coverage(mesh: Mesh, grid: Grid, progress: Progress | None = None) -> NDArray[np.float32]:
    """Share of each voxel that lies inside a closed mesh, 0 to 1, float32 array of the grid's shape.

    Where the mesh runs through itself, what any part of it encloses is inside.
    """
    require_closed(mesh)
    coverage = np.zeros(grid.shape, np.float32)
    back = grid.index_from_world
    # Voxel i lies between the planes i and i + 1.
    corners = (mesh.vertices @ back[:3, :3].T + back[:3, 3] + 0.5)[mesh.faces]
    n_x, n_y, n_z = grid.shape
    corners = _between(corners, 1, 0, n_y)
    corners = _cut(corners, 2, np.full(len(corners), n_z))[0]  # what is behind the last voxel covers none
    corners[:, :, 2] = corners[:, :, 2].clip(0, None)  # what is in front of the first covers all of its column
    low, high = (corners[:, :, 0].min(axis=1), corners[:, :, 0].max(axis=1)) if len(corners) else (np.empty(0),) * 2
    slab = max(1, _COLUMNS // n_y)
    for first in range(0, n_x, slab):
        last = min(first + slab, n_x)
        part = _between(corners[(low < last) & (high > first)], 0, first, last)
        if len(part):
            for axis in range(3):
                part = _split(part, axis)
            winding = _winding(part - [first, 0, 0], (last - first, n_y, n_z))
            covered = np.minimum(np.abs(winding), 1)
            covered[covered < _ROUNDING] = 0
            covered[covered > 1 - _ROUNDING] = 1
            coverage[first:last] = covered
        if progress is not None:
            progress(last, n_x)
    return coverage


def _winding(pieces: NDArray[np.float64], shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """Mean winding number of each voxel from `pieces` (N, 3, 3) of the surface, each within one voxel."""
    a, b, c = (pieces[:, i] for i in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2  # seen along z, with its sign
    middle = pieces.mean(axis=1)
    n_x, n_y, n_z = shape
    i, j, k = np.floor(middle).astype(np.int64).clip(0, np.array(shape) - 1).T
    own = area * (k + 1 - middle[:, 2])
    voxel = (i * n_y + j) * (n_z + 1) + k
    size = n_x * n_y * (n_z + 1)
    steps = np.bincount(voxel, own, size) + np.bincount(voxel + 1, area - own, size)
    return np.cumsum(steps.reshape(n_x, n_y, n_z + 1), axis=2)[:, :, :n_z]


def _split(pieces: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """The pieces, cut at every whole number along `axis` that they cross."""
    done = []
    while len(pieces):
        low, high = np.floor(pieces[:, :, axis].min(axis=1)), np.ceil(pieces[:, :, axis].max(axis=1))
        whole = high - low <= 1
        done.append(pieces[whole])
        pieces = np.concatenate(_cut(pieces[~whole], axis, (low + high)[~whole] // 2))
    return np.concatenate(done) if done else pieces


def _between(triangles: NDArray[np.float64], axis: int, low: float, high: float) -> NDArray[np.float64]:
    """What of the triangles lies between two planes."""
    below, _ = _cut(triangles, axis, np.full(len(triangles), high))
    return _cut(below, axis, np.full(len(below), low))[1]


def _cut(
    triangles: NDArray[np.float64], axis: int, plane: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The parts (n, 3, 3) of each triangle below and above its `plane` (N,), a coordinate along `axis`."""
    beyond = triangles[:, :, axis] - plane[:, None]
    below, above = (beyond <= 0).all(axis=1), (beyond >= 0).all(axis=1) & (beyond > 0).any(axis=1)
    crossing = ~(below | above)
    triangles_below, triangles_above = triangles[below], triangles[above]
    cut, beyond, plane = triangles[crossing], beyond[crossing], plane[crossing]
    # The corner that is alone on its side comes first; the order around the triangle stays.
    over = beyond > 0
    alone_is_over = over.sum(axis=1) == 1
    alone = np.where(alone_is_over[:, None], over, ~over).argmax(axis=1)
    order = (alone[:, None] + np.arange(3)) % 3
    rows = np.arange(len(cut))[:, None]
    cut, beyond = cut[rows, order], beyond[rows, order]
    tip, left, right = cut[:, 0], cut[:, 1], cut[:, 2]
    on_left = tip + (beyond[:, 0] / (beyond[:, 0] - beyond[:, 1]))[:, None] * (left - tip)
    on_right = tip + (beyond[:, 0] / (beyond[:, 0] - beyond[:, 2]))[:, None] * (right - tip)
    on_left[:, axis] = on_right[:, axis] = plane
    tips = np.stack([tip, on_left, on_right], axis=1)
    rests = np.concatenate([np.stack([on_left, left, right], axis=1), np.stack([on_left, right, on_right], axis=1)])
    over_twice = np.concatenate([alone_is_over] * 2)
    return (
        np.concatenate([triangles_below, tips[~alone_is_over], rests[over_twice]]),
        np.concatenate([triangles_above, tips[alone_is_over], rests[~over_twice]]),
    )


def _is_pair(given: Sequence[Any]) -> bool:
    """Whether `given` is (vertices, faces) rather than a sequence of meshes."""
    if len(given) != 2 or any(isinstance(part, str | os.PathLike | Mesh) or hasattr(part, "faces") for part in given):
        return False
    return np.ndim(given[0]) == 2
