"""Voxelisation of closed meshes: the exact fraction of every voxel that lies inside.

The triangles are cut at all planes between voxels. Each piece then bounds a prism that extends from it along z to the end of
its column of voxels: the prism covers a known part of the piece's own voxel, and the piece's projected area of each further
voxel. The sum of the prisms, with the sign of the side to which the piece looks, is the mean winding number of each voxel
(the divergence theorem). It equals the covered fraction, unless the mesh intersects itself: a voxel there may contain parts
of winding number 0 and 2. In columns of voxels with such parts, the fraction is the mean length inside along many rays
parallel to z.
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

_VOXELS, _POLYGONS = 1 << 21, 1 << 14  # processed at a time
# For meshes that intersect themselves: number of rays, their largest distance in voxels, and pairs of triangle and ray that
# are tested at a time.
_RAYS, _STEP, _CANDIDATES = 1 << 18, 0.25, 1 << 20
_ROUNDING = 1e-9  # fractions this close to 0 and 1 are 0 and 1


def voxelize_mesh(
    mesh: Any, grid: Grid, value: ArrayLike = 1.0, quantity: str = "activity", progress: Progress | None = None
) -> Volume:
    """Return a volume filled by one or several closed meshes; parts outside the grid are cut off.

    Parameters
    ----------
    mesh
        A `Mesh`, a trimesh mesh or scene, ``(vertices (V, 3), faces (F, 3))`` in world mm, or the path of a file (see
        `read_mesh`); or a list of these, in which later meshes replace the values of earlier ones. Messages say where a
        mesh is open or its faces look to different sides.
    grid
        Grid of the volume, with any affine.
    value
        Value inside, in the quantity's unit: one number, or one for each mesh. Outside, the volume is 0.
    quantity
        Quantity of the values.
    progress
        Called as ``progress(done, total)``; may raise `Cancelled`.
    """
    instance(grid, Grid, "voxelize_mesh")
    is_list = isinstance(mesh, Sequence) and not isinstance(mesh, str)
    if is_list and len(mesh) == 2:  # two meshes, or the vertices and faces of one
        is_list = any(isinstance(item, str | os.PathLike | Mesh) or hasattr(item, "faces") for item in mesh)
        is_list = is_list or np.ndim(mesh[0]) != 2
    meshes = [as_mesh(source) for source in (mesh if is_list else [mesh])]
    if not meshes:
        raise InputError("voxelize_mesh: expected at least one mesh")
    values = one_for_all(value, "value", len(meshes))
    require(8.5 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    array = np.zeros(grid.shape, np.float32)
    for i, (mesh, mesh_value) in enumerate(zip(meshes, values, strict=True)):
        coverage = mesh_coverage(mesh, grid, part_of(progress, i, len(meshes)))
        array += coverage * (np.float32(mesh_value) - array)
    return Volume(freeze(array), grid, quantity)


def mesh_coverage(mesh: Mesh, grid: Grid, progress: Progress | None = None) -> Floats32:
    """Return the fraction of each voxel that lies inside a closed mesh, 0 to 1, a float32 array of the grid's shape.

    Where the mesh intersects itself, all points that any part of it encloses are inside; there the fractions are
    approximate, their sum to about 1/10000, in long voxels to 1/1000.
    """
    require_closed(mesh)
    coverage = np.zeros(grid.shape, np.float32)
    # In these coordinates, voxel i lies between the planes i and i + 1.
    corners = (moved(grid.index_from_world, mesh.vertices) + 0.5)[mesh.faces]
    start = np.floor(corners.min(axis=(0, 1))).clip(0, grid.shape).astype(int)
    stop = np.ceil(corners.max(axis=(0, 1))).clip(0, grid.shape).astype(int)
    if np.any(start >= stop):
        return coverage
    box = coverage[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
    n_x, n_y, n_z = box.shape
    surface = _drop_vertical(_clip_between(_clip_between(corners - start, 0, 0, n_x), 1, 0, n_y))
    # A piece in front of a column covers all of the column; a piece behind it, nothing.
    in_front = _clip(surface[surface[:, :, 2].min(axis=1) < 0], 2, 0, -1)
    in_front[:, :, 2] = 0
    surface = _drop_vertical(_concatenate([in_front, _clip_between(surface, 2, 0, n_z)]))
    # A voxel's mean cannot distinguish winding numbers 0 and 2, or -1 and 1, from 1 and 0; rays through the whole box can.
    is_mixed = _ray_coverage((corners - start) / [n_x, n_y, 1], (1, 1, 1), (_STEP / 32, _STEP / 32))[1].any()
    # Rays for the fractions there: the area of a column per ray, and the rays' distance along x, in proportion to the box if
    # possible.
    area = min(n_x * n_y / _RAYS, _STEP**2)
    step = min(max(math.sqrt(area * n_x / n_y), area / _STEP), _STEP)
    thickness = max(1, min(_VOXELS // (n_y * n_z), int(_RAYS * area / n_y)))
    low, high = surface[:, :, 0].min(axis=1), surface[:, :, 0].max(axis=1)
    for first in range(0, n_x, thickness):
        last = min(first + thickness, n_x)
        n = last - first
        pieces = _clip_between(surface[(low < last) & (high > first)], 0, first, last) - [first, 0, 0]
        fraction = np.abs(_winding_numbers(pieces, (n, n_y, n_z)))
        if is_mixed or fraction.max() > 1 + _ROUNDING:
            ray_fraction, overlap = _ray_coverage(pieces, (n, n_y, n_z), (step, area / step))
            fraction[overlap] = ray_fraction[overlap]
        box[first:last] = np.where(fraction < _ROUNDING, 0, np.where(fraction > 1 - _ROUNDING, 1, fraction))
        tell(progress, last, n_x)
    return coverage


def _ray_coverage(surface: Floats, shape: tuple[int, int, int], step: tuple[float, float]) -> tuple[Floats, Bools]:
    """Return the fraction of each voxel inside a surface of polygons (N, V, 3), and the columns with overlaps (n_x, n_y).

    The fractions are means over rays along z, `step` voxels apart in x and y. In a column with overlaps there are winding
    numbers other than 0 and 1, or 0 and -1.
    """
    n_x, n_y, n_z = shape
    # The lattice's rows follow no axis, so that walls along the voxels are met at many different positions.
    slope = (math.sqrt(5) - 1) / 2
    lattice = np.array([[1, slope], [-slope, 1]]) / math.hypot(1, slope) * step  # rows: the lattice's steps, in voxels
    corners = np.array([[0, 0], [n_x, 0], [0, n_y], [n_x, n_y]]) @ np.linalg.inv(lattice)
    start = np.floor(corners.min(axis=0)).astype(np.int64)
    size = np.ceil(corners.max(axis=0)).astype(np.int64) + 1 - start
    column = np.floor((np.indices(tuple(size.tolist())).reshape(2, -1).T + start) @ lattice).astype(np.int64)
    in_box = ((column >= 0) & (column < (n_x, n_y))).all(axis=1)
    column = np.where(in_box, column[:, 0] * n_y + column[:, 1], 0)
    n_rays = np.bincount(column[in_box], minlength=n_x * n_y).reshape(n_x, n_y, 1)

    triangles = np.concatenate([surface[:, [0, i, i + 1]] for i in range(1, surface.shape[1] - 1)])
    ray, z, side = _crossings(triangles, triangles[:, :, :2] @ np.linalg.inv(lattice) - start, size)
    order = np.lexsort((z, ray))
    ray, z, side = ray[order], z[order], side[order]
    winding = np.cumsum(side)  # the winding number beyond each crossing, plus a sum over all rays before
    _, firsts, counts = np.unique(ray, return_index=True, return_counts=True)
    winding -= np.repeat((winding - side)[firsts], counts)
    enters = (winding != 0).astype(np.int64) - (winding != side)  # 1 where the ray enters, -1 where it leaves
    voxel = np.floor(z).astype(np.int64).clip(0, n_z - 1)
    index, change = column[ray] * (n_z + 1) + voxel, enters * (voxel + 1 - z)
    steps = np.zeros(n_x * n_y * (n_z + 1))  # of the length inside, from each voxel to the next
    np.add.at(steps, index, change)
    np.add.at(steps, index + 1, enters - change)
    fraction = np.cumsum(steps.reshape(n_x, n_y, n_z + 1), axis=2)[:, :, :n_z] / n_rays
    winding *= np.diff(z, append=0) > _ROUNDING  # not where one part ends and the next begins
    lowest, highest = np.zeros((2, n_x * n_y), np.int64)
    np.minimum.at(lowest, column[ray], winding)
    np.maximum.at(highest, column[ray], winding)
    return fraction, (highest - lowest).reshape(n_x, n_y) > 1


def _crossings(triangles: Floats, projected: Floats, size: Integers) -> tuple[Integers, Floats, Integers]:
    """Return the crossings (K,) of rays along z with `triangles` (N, 3, 3): number of the ray, z, and side.

    The side is 1 or -1, the sign of the triangle's projected area. The rays form a lattice of `size` (2,); `projected`
    (N, 3, 2) are the triangles' corners in lattice coordinates.
    """
    low = np.ceil(projected.min(axis=1)).astype(np.int64).clip(0, size)
    extent = (np.floor(projected.max(axis=1)).astype(np.int64).clip(-1, size - 1) - low + 1).clip(0)
    n_rays = extent.prod(axis=1)  # in the bounding rectangle of each triangle
    crossings = []
    for block in np.split(np.arange(len(n_rays)), np.flatnonzero(np.diff(np.cumsum(n_rays) // _CANDIDATES)) + 1):
        triangle = np.repeat(block, n_rays[block])
        number = np.arange(len(triangle)) - np.repeat(np.cumsum(n_rays[block]) - n_rays[block], n_rays[block])
        ray = low[triangle] + np.stack(np.divmod(number, extent[triangle, 1]), axis=1)
        a, b, c = (projected[triangle] - ray[:, None]).transpose(1, 2, 0)
        # Twice the areas of the triangles between the ray and each side: barycentric coordinates times their sum.
        areas = np.stack([p[0] * q[1] - p[1] * q[0] for p, q in ((b, c), (c, a), (a, b))])
        is_hit = (areas > 0).all(axis=0) | (areas < 0).all(axis=0)
        areas = areas[:, is_hit]
        total = areas.sum(axis=0)
        z = np.einsum("in,ni->n", areas, triangles[triangle[is_hit], :, 2]) / total
        crossings.append((ray[is_hit] @ [size[1], 1], z, np.sign(total).astype(np.int64)))
    ray, z, side = map(np.concatenate, zip(*crossings, strict=True))
    return ray, z, side


def _winding_numbers(surface: Floats, shape: tuple[int, int, int]) -> Floats:
    """Return the mean winding number of each voxel with respect to a surface of polygons (N, V, 3)."""
    n_x, n_y, n_z = shape
    steps = np.zeros(n_x * n_y * (n_z + 1))  # of the winding number, from each voxel to the next
    for first in range(0, len(surface), _POLYGONS):
        pieces = surface[first : first + _POLYGONS]
        cells = np.zeros((len(pieces), 3), np.int64)
        for axis in range(3):
            pieces, cells = _split(pieces, cells, axis, shape[axis])
        area, moment = np.zeros(len(pieces)), np.zeros(len(pieces))
        apex = pieces[:, 0]
        for i in range(1, pieces.shape[1] - 1):  # a fan of triangles
            a, b = pieces[:, i] - apex, pieces[:, i + 1] - apex
            # Area of the projection along z, with the sign of the side to which the triangle looks.
            triangle_area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
            area += triangle_area
            moment += triangle_area * (apex[:, 2] + (a[:, 2] + b[:, 2]) / 3)
        prism = area * (cells[:, 2] + 1) - moment  # the prism's volume in the piece's own voxel
        voxel = (cells[:, 0] * n_y + cells[:, 1]) * (n_z + 1) + cells[:, 2]
        np.add.at(steps, voxel, prism)
        np.add.at(steps, voxel + 1, area - prism)
    return np.cumsum(steps.reshape(n_x, n_y, n_z + 1), axis=2)[:, :, :n_z]


def _split(pieces: Floats, cells: Integers, axis: int, n: int) -> tuple[Floats, Integers]:
    """Cut `pieces` (N, V, 3) at the whole numbers along `axis`; return the parts, and their `cells` with that index set.

    `cells` (N, 3) are the voxel indices of the pieces; `n` is the number of voxels along the axis.
    """
    low = np.floor(pieces[:, :, axis].min(axis=1)).astype(np.int64).clip(0, n - 1)
    high = np.ceil(pieces[:, :, axis].max(axis=1)).astype(np.int64).clip(low + 1, n)
    counts = high - low
    uncut, cut = np.flatnonzero(counts == 1), np.flatnonzero(counts > 1)
    parent = np.repeat(cut, counts[cut])
    first = np.cumsum(counts[cut]) - counts[cut]
    cell = low[parent] + np.arange(len(parent)) - np.repeat(first, counts[cut])
    parts = _clip_between(pieces[parent], axis, cell, cell + 1)
    cells = cells[np.concatenate([uncut, parent])]
    cells[:, axis] = np.concatenate([low[uncut], cell])
    return _concatenate([pieces[uncut], parts]), cells


def _concatenate(groups: list[Floats]) -> Floats:
    """Return groups of pieces (N, V, 3) with different numbers V of corners in one array, their last corners repeated."""
    n_corners = max(pieces.shape[1] for pieces in groups)
    return np.concatenate([pieces[:, np.minimum(np.arange(n_corners), pieces.shape[1] - 1)] for pieces in groups])


def _clip_between(pieces: Floats, axis: int, low: ArrayLike, high: ArrayLike) -> Floats:
    """Return the parts of convex `pieces` (N, V, 3) between the planes at `low` and `high` along `axis`."""
    return _clip(_clip(pieces, axis, low, 1), axis, high, -1)


def _drop_vertical(pieces: Floats) -> Floats:
    """Return the `pieces` (N, V, 3) whose projection along z has an area; others cover nothing."""
    return pieces[(np.ptp(pieces[:, :, :2], axis=1) > 0).all(axis=1)]


def _clip(pieces: Floats, axis: int, plane: ArrayLike, side: int) -> Floats:
    """Return the parts (N, W, 3) of convex `pieces` (N, V, 3) above (`side` 1) or below (-1) the `plane`.

    `plane` is its position along `axis`, one for all pieces or one for each (N,). I. Sutherland, G. Hodgman, "Reentrant
    polygon clipping", CACM 17 (1974). Spare corners repeat the last one; a piece that lies completely on the other side
    becomes a point.
    """
    n, n_corners = pieces.shape[:2]
    plane = np.broadcast_to(plane, n)
    depth = side * (pieces[:, :, axis] - plane[:, None])
    if not (depth < 0).any():
        return pieces
    next_depth = np.roll(depth, -1, axis=1)
    crosses = (depth > 0) & (next_depth < 0) | (depth < 0) & (next_depth > 0)
    piece, corner = np.nonzero(crosses)
    start, end = pieces[piece, corner], pieces[piece, (corner + 1) % n_corners]
    fraction = depth[piece, corner] / (depth[piece, corner] - next_depth[piece, corner])
    points = np.stack([pieces, pieces], axis=2)  # each corner, and the crossing on the edge from it
    points[piece, corner, 1] = start + fraction[:, None] * (end - start)
    points[piece, corner, 1, axis] = plane[piece]
    points = points.reshape(n, 2 * n_corners, 3)
    is_kept = np.stack([depth >= 0, crosses], axis=2).reshape(n, 2 * n_corners)
    number = np.cumsum(is_kept, axis=1)  # from 1, among the kept points of the piece
    count = number[:, -1:]
    width = max(3, int(count.max(initial=0)))
    result = np.zeros((n, width, 3))
    piece, corner = np.nonzero(is_kept)
    result[piece, number[piece, corner] - 1] = points[piece, corner]
    is_spare = np.arange(width) >= count
    last = result[np.arange(n), np.maximum(count[:, 0] - 1, 0)]
    return np.where(is_spare[:, :, None], last[:, None], result)
