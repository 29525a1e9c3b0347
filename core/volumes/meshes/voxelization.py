"""Closed meshes to volumes: the share of every voxel that lies inside, exactly.

The triangles are cut at all planes between voxels. Each piece then bounds a prism that reaches from it to the end of its
column of voxels: it covers a known part of the piece's own voxel, and the piece's area of each further voxel. The prisms,
summed with the sign of the side to which the piece looks, give the mean winding number of each voxel (the divergence
theorem). That is the covered share, unless the mesh intersects itself: a voxel there may hold parts of winding number 0 and
2. In columns of voxels with such places the share is the mean over many rays along z of the length inside.
"""

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...arrays import ArrayLike, Bools, Floats, Floats32, Integers
from ...errors import InputError
from ...geometry.frames import moved
from ...geometry.grid import Grid
from ...memory import require
from ...progress import Progress, part_of, tell
from ...validation import freeze, instance, one_for_all
from ..volume import Volume
from .mesh import Mesh, as_mesh, require_closed

_VOXELS, _POLYGONS = 1 << 21, 1 << 14  # at once
# Where a mesh intersects itself: rays for all of it, their largest distance in voxels, and pairs of triangle and ray to
# test at once.
_RAYS, _STEP, _CANDIDATES = 1 << 18, 0.25, 1 << 20
_ROUNDING = 1e-9  # shares this close to 0 and 1 are 0 and 1


def voxelize_mesh(
    mesh: Any,
    grid: Grid,
    value: ArrayLike = 1.0,
    quantity: str = "activity",
    progress: Progress | None = None,
) -> Volume:
    """A volume filled by one closed mesh or by several; parts outside the grid are cut off.

    Parameters
    ----------
    mesh
        A `Mesh`, a trimesh mesh or scene, ``(vertices (V, 3), faces (F, 3))`` in world mm, or the path of a file (see
        `read_mesh`); or a list of these, in which later ones replace what they cover of earlier ones. Messages say
        where a mesh is open or its faces look to different sides.
    grid
        Where the voxels are; any affine.
    value
        Inside, in the quantity's unit: one number, or one for each mesh. Outside, the volume is 0.
    quantity
        What the values are.
    progress
        Called as ``progress(done, total)``; may raise `Cancelled`.
    """
    instance(grid, Grid, "voxelize_mesh")
    several = isinstance(mesh, Sequence) and not isinstance(mesh, str)
    if several and len(mesh) == 2:  # meshes, or vertices and faces
        several = any(isinstance(part, str | os.PathLike | Mesh) or hasattr(part, "faces") for part in mesh)
        several = several or np.ndim(mesh[0]) != 2
    meshes = [as_mesh(one) for one in (mesh if several else [mesh])]
    if not meshes:
        raise InputError("voxelize_mesh: expected at least one mesh")
    values = one_for_all(value, "value", len(meshes))
    require(8.5 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    array = np.zeros(grid.shape, np.float32)
    for i, (one, inside) in enumerate(zip(meshes, values, strict=True)):
        covered = mesh_coverage(one, grid, part_of(progress, i, len(meshes)))
        array += covered * (np.float32(inside) - array)
    return Volume(freeze(array), grid, quantity)


def mesh_coverage(mesh: Mesh, grid: Grid, progress: Progress | None = None) -> Floats32:
    """Share of each voxel that lies inside a closed mesh, 0 to 1, float32 array of the grid's shape.

    Where the mesh intersects itself, everything that any part of it encloses is inside; there the shares are approximate,
    their sum to about 1/10000, in long voxels to 1/1000.
    """
    require_closed(mesh)
    coverage = np.zeros(grid.shape, np.float32)
    # Voxel i lies between the planes i and i + 1.
    corners = (moved(grid.index_from_world, mesh.vertices) + 0.5)[mesh.faces]
    start = np.floor(corners.min(axis=(0, 1))).clip(0, grid.shape).astype(int)
    stop = np.ceil(corners.max(axis=(0, 1))).clip(0, grid.shape).astype(int)
    if np.any(start >= stop):
        return coverage
    box = coverage[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
    n_x, n_y, n_z = box.shape
    surface = _seen(_slab(_slab(corners - start, 0, 0, n_x), 1, 0, n_y))
    # A piece in front of a column covers all of the column; a piece behind it, nothing.
    in_front = _clip(surface[surface[:, :, 2].min(axis=1) < 0], 2, 0, -1)
    in_front[:, :, 2] = 0
    surface = _seen(_joined([in_front, _slab(surface, 2, 0, n_z)]))
    # A voxel's mean does not tell the winding numbers 0 and 2, or -1 and 1, from 1 and 0: rays through the whole box do.
    is_mixed = _along_rays((corners - start) / [n_x, n_y, 1], (1, 1, 1), (_STEP / 32, _STEP / 32))[1].any()
    # Rays for the shares there: their area in columns, and their distance along x, in proportion to the box if possible.
    area = min(n_x * n_y / _RAYS, _STEP**2)
    step = min(max(math.sqrt(area * n_x / n_y), area / _STEP), _STEP)
    thickness = max(1, min(_VOXELS // (n_y * n_z), int(_RAYS * area / n_y)))
    low, high = surface[:, :, 0].min(axis=1), surface[:, :, 0].max(axis=1)
    for first in range(0, n_x, thickness):
        last = min(first + thickness, n_x)
        n = last - first
        pieces = _slab(surface[(low < last) & (high > first)], 0, first, last) - [first, 0, 0]
        covered = np.abs(_winding(pieces, (n, n_y, n_z)))
        if is_mixed or covered.max() > 1 + _ROUNDING:
            by_rays, overlap = _along_rays(pieces, (n, n_y, n_z), (step, area / step))
            covered[overlap] = by_rays[overlap]
        box[first:last] = np.where(covered < _ROUNDING, 0, np.where(covered > 1 - _ROUNDING, 1, covered))
        tell(progress, last, n_x)
    return coverage


def _along_rays(surface: Floats, shape: tuple[int, int, int], step: tuple[float, float]) -> tuple[Floats, Bools]:
    """The shares of voxels inside the surface of polygons (N, V, 3), from rays along z, `step` voxels apart in x and y.

    Also the columns of voxels (n_x, n_y) in which there are winding numbers other than 0 and 1, or 0 and -1.
    """
    n_x, n_y, n_z = shape
    # A lattice whose rows follow no axis, so that walls along the voxels are met at many different places.
    slope = (math.sqrt(5) - 1) / 2
    lattice = np.array([[1, slope], [-slope, 1]]) / math.hypot(1, slope) * step  # its two steps, in voxels
    corners = np.array([[0, 0], [n_x, 0], [0, n_y], [n_x, n_y]]) @ np.linalg.inv(lattice)
    start = np.floor(corners.min(axis=0)).astype(np.int64)
    size = np.ceil(corners.max(axis=0)).astype(np.int64) + 1 - start
    column = np.floor((np.indices(tuple(size.tolist())).reshape(2, -1).T + start) @ lattice).astype(np.int64)
    held = ((column >= 0) & (column < (n_x, n_y))).all(axis=1)
    column = np.where(held, column[:, 0] * n_y + column[:, 1], 0)
    n_rays = np.bincount(column[held], minlength=n_x * n_y).reshape(n_x, n_y, 1)

    triangles = np.concatenate([surface[:, [0, i, i + 1]] for i in range(1, surface.shape[1] - 1)])
    ray, z, side = _crossings(triangles, triangles[:, :, :2] @ np.linalg.inv(lattice) - start, size)
    order = np.lexsort((z, ray))
    ray, z, side = ray[order], z[order], side[order]
    after = np.cumsum(side)  # the winding number, up to the sum over the rays before
    _, firsts, counts = np.unique(ray, return_index=True, return_counts=True)
    after -= np.repeat((after - side)[firsts], counts)
    enters = (after != 0).astype(np.int64) - (after != side)  # 1 where the ray enters, -1 where it leaves
    voxel = np.floor(z).astype(np.int64).clip(0, n_z - 1)
    place, own = column[ray] * (n_z + 1) + voxel, enters * (voxel + 1 - z)
    steps = np.zeros(n_x * n_y * (n_z + 1))
    np.add.at(steps, place, own)
    np.add.at(steps, place + 1, enters - own)
    covered = np.cumsum(steps.reshape(n_x, n_y, n_z + 1), axis=2)[:, :, :n_z] / n_rays
    numbers = after * (np.diff(z, append=0) > _ROUNDING)  # not where one part ends and the next begins
    lowest, highest = np.zeros((2, n_x * n_y), np.int64)
    np.minimum.at(lowest, column[ray], numbers)
    np.maximum.at(highest, column[ray], numbers)
    return covered, (highest - lowest).reshape(n_x, n_y) > 1


def _crossings(triangles: Floats, seen: Floats, size: Integers) -> tuple[Integers, Floats, Integers]:
    """Where rays along z meet `triangles` (N, 3, 3): the ray's number, z, and 1 or -1 for the side of the triangle.

    The rays form a lattice of `size` (2,); `seen` (N, 3, 2) are the corners in lattice coordinates.
    """
    low = np.ceil(seen.min(axis=1)).astype(np.int64).clip(0, size)
    extent = (np.floor(seen.max(axis=1)).astype(np.int64).clip(-1, size - 1) - low + 1).clip(0)
    number = extent.prod(axis=1)
    found = []
    for some in np.split(np.arange(len(number)), np.flatnonzero(np.diff(np.cumsum(number) // _CANDIDATES)) + 1):
        of = np.repeat(some, number[some])
        nth = np.arange(len(of)) - np.repeat(np.cumsum(number[some]) - number[some], number[some])
        at = low[of] + np.stack(np.divmod(nth, extent[of, 1]), axis=1)
        a, b, c = (seen[of] - at[:, None]).transpose(1, 2, 0)
        # Twice the areas between the ray and each side.
        parts = np.stack([p[0] * q[1] - p[1] * q[0] for p, q in ((b, c), (c, a), (a, b))])
        hit = (parts > 0).all(axis=0) | (parts < 0).all(axis=0)
        parts = parts[:, hit]
        whole = parts.sum(axis=0)
        z = np.einsum("in,ni->n", parts, triangles[of[hit], :, 2]) / whole
        found.append((at[hit] @ [size[1], 1], z, np.sign(whole).astype(np.int64)))
    ray, z, side = map(np.concatenate, zip(*found, strict=True))
    return ray, z, side


def _winding(surface: Floats, shape: tuple[int, int, int]) -> Floats:
    """Mean winding number of each voxel with respect to a surface of polygons (N, V, 3)."""
    n_x, n_y, n_z = shape
    steps = np.zeros(n_x * n_y * (n_z + 1))  # in the winding number, from each voxel to the next
    for first in range(0, len(surface), _POLYGONS):
        pieces = surface[first : first + _POLYGONS]
        cells = np.zeros((len(pieces), 3), np.int64)
        for axis in range(3):
            pieces, cells = _split(pieces, cells, axis, shape[axis])
        area, moment = np.zeros(len(pieces)), np.zeros(len(pieces))
        tip = pieces[:, 0]
        for i in range(1, pieces.shape[1] - 1):  # a fan of triangles
            left, right = pieces[:, i] - tip, pieces[:, i + 1] - tip
            # As seen along z: positive or negative, by its side.
            part = (left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]) / 2
            area += part
            moment += part * (tip[:, 2] + (left[:, 2] + right[:, 2]) / 3)
        own = area * (cells[:, 2] + 1) - moment
        voxel = (cells[:, 0] * n_y + cells[:, 1]) * (n_z + 1) + cells[:, 2]
        np.add.at(steps, voxel, own)
        np.add.at(steps, voxel + 1, area - own)
    return np.cumsum(steps.reshape(n_x, n_y, n_z + 1), axis=2)[:, :, :n_z]


def _split(pieces: Floats, cells: Integers, axis: int, n: int) -> tuple[Floats, Integers]:
    """The `pieces` (N, V, 3) cut at the whole numbers along `axis`, and `cells` (N, 3) with their index along it."""
    low = np.floor(pieces[:, :, axis].min(axis=1)).astype(np.int64).clip(0, n - 1)
    high = np.ceil(pieces[:, :, axis].max(axis=1)).astype(np.int64).clip(low + 1, n)
    counts = high - low
    whole, several = np.flatnonzero(counts == 1), np.flatnonzero(counts > 1)
    of = np.repeat(several, counts[several])
    before = np.cumsum(counts[several]) - counts[several]
    cell = low[of] + np.arange(len(of)) - np.repeat(before, counts[several])
    parts = _slab(pieces[of], axis, cell, cell + 1)
    cells = cells[np.concatenate([whole, of])]
    cells[:, axis] = np.concatenate([low[whole], cell])
    return _joined([pieces[whole], parts]), cells


def _joined(pieces: list[Floats]) -> Floats:
    """Pieces with different numbers of corners in one array; the last corner is repeated."""
    corners = max(part.shape[1] for part in pieces)
    return np.concatenate([part[:, np.minimum(np.arange(corners), part.shape[1] - 1)] for part in pieces])


def _slab(pieces: Floats, axis: int, low: ArrayLike, high: ArrayLike) -> Floats:
    """The parts of `pieces` between two planes each."""
    return _clip(_clip(pieces, axis, low, 1), axis, high, -1)


def _seen(pieces: Floats) -> Floats:
    """Those `pieces` that have an area as seen along z; the others cover nothing."""
    return pieces[(np.ptp(pieces[:, :, :2], axis=1) > 0).all(axis=1)]


def _clip(pieces: Floats, axis: int, plane: ArrayLike, side: int) -> Floats:
    """The parts of convex `pieces` (N, V, 3) above (`side` 1) or below (-1) each one's `plane`: (N, W, 3).

    I. Sutherland, G. Hodgman, "Reentrant polygon clipping", CACM 17 (1974). Spare corners repeat the last one; a piece that
    lies on the other side completely becomes a point.
    """
    n, corners = pieces.shape[:2]
    plane = np.broadcast_to(plane, n)
    depth = side * (pieces[:, :, axis] - plane[:, None])
    if not (depth < 0).any():
        return pieces
    following = np.roll(depth, -1, axis=1)
    crosses = (depth > 0) & (following < 0) | (depth < 0) & (following > 0)
    of, corner = np.nonzero(crosses)
    start, end = pieces[of, corner], pieces[of, (corner + 1) % corners]
    share = depth[of, corner] / (depth[of, corner] - following[of, corner])
    points = np.stack([pieces, pieces], axis=2)  # each corner, and the crossing on the edge from it
    points[of, corner, 1] = start + share[:, None] * (end - start)
    points[of, corner, 1, axis] = plane[of]
    points = points.reshape(n, 2 * corners, 3)
    kept = np.stack([depth >= 0, crosses], axis=2).reshape(n, 2 * corners)
    place = np.cumsum(kept, axis=1)
    count = place[:, -1:]
    width = max(3, int(count.max(initial=0)))
    result = np.zeros((n, width, 3))
    of, corner = np.nonzero(kept)
    result[of, place[of, corner] - 1] = points[of, corner]
    spare = np.arange(width) >= count
    last = result[np.arange(n), np.maximum(count[:, 0] - 1, 0)]
    return np.where(spare[:, :, None], last[:, None], result)
