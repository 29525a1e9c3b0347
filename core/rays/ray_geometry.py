"""Rays in world mm and in index space, and the change from one to the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..arrays import Floats
from ..geometry.grid import Grid
from ..geometry.views import Views

# Distance, voxels, from a plane of voxel faces up to which a ray lies in the plane, and change along an axis up to which it
# is parallel to its planes. Rounding moves a coordinate by about 1e-12 voxels (a rotated grid, a source thousands of voxels
# away).
SNAP = 1e-9

_UNSHIFTED, _ALL = np.zeros((1, 2)), slice(None)


@dataclass(frozen=True, eq=False)
class Fan:
    """Rays from one point to the points of a lattice on a plane, world mm: the rays of an image.

    The ray of row i and column j goes from `source` to ``corner + i row_step + j column_step``; a parallel ray begins at
    ``source + i row_step + j column_step``. Rays of one point may also begin in a plane on their way: then their starts move
    `parallel` times as far as their ends. With S shifts there are S such lattices, each moved by a number of rows and
    columns: more points of every pixel.
    """

    source: Floats
    """(3,), source of the rays, mm; of parallel ones that of the first."""
    corner: Floats
    """(3,), end of the ray of the first row and column, mm."""
    row_step: Floats
    """(3,), step from row to row, mm."""
    column_step: Floats
    """(3,), step from column to column, mm."""
    shape: tuple[int, int]
    """Number of rows and columns."""
    shifts: Floats = field(default_factory=lambda: _UNSHIFTED)
    """(S, 2), shifts of the lattices, in rows and columns."""
    parallel: float = 0.0
    """Motion of the rays' starts in units of that of their ends, 0 for one source, 1 for parallel rays."""

    def part(self, rows: slice, columns: slice, shifts: slice = _ALL) -> Fan:
        """Return the fan of some rows, columns and shifts."""
        row, last_row, _ = rows.indices(self.shape[0])
        column, last_column, _ = columns.indices(self.shape[1])
        offset = row * self.row_step + column * self.column_step
        source, corner = self.source + self.parallel * offset, self.corner + offset
        shape = last_row - row, last_column - column
        return replace(self, source=source, corner=corner, shape=shape, shifts=self.shifts[shifts])

    def transposed(self) -> Fan:
        """Return the same rays with rows and columns exchanged."""
        shifts = self.shifts if self.shifts is _UNSHIFTED else self.shifts[:, ::-1]
        return Fan(self.source, self.corner, self.column_step, self.row_step, self.shape[::-1], shifts, self.parallel)

    def lies_across(self, grid: Grid) -> bool:
        """Return whether neighbours in the voxels' memory are neighbours in a column rather than in a row."""
        contiguous = grid.index_from_world[2, :3]
        return bool(abs(contiguous @ self.row_step) > abs(contiguous @ self.column_step))

    def vectors(self) -> Floats:
        """Return source, corner, row step and column step of the S lattices, (S, 4, 3)."""
        vectors = np.empty((len(self.shifts), 4, 3))
        vectors[:] = self.source, self.corner, self.row_step, self.column_step
        if self.shifts is not _UNSHIFTED:
            offsets = self.shifts @ vectors[0, 2:]
            vectors[:, 0] += self.parallel * offsets
            vectors[:, 1] += offsets
        return vectors

    def targets(self) -> Floats:
        """Return the ends of the rays (S * rows * columns, 3), shift by shift, row by row."""
        return _targets(self.vectors(), self.shape)


def view_rays(views: Views, m: int, grid: Grid | None = None) -> Fan:
    """Return the rays of view m, from its source to the pixels' centres: a row for every row of pixels.

    Parallel rays begin and end outside `grid`, close to it; without a grid they are those of `Views.rays`.
    """
    n_v, n_u = views.shape
    u_step, v_step = views.u_steps[m], views.v_steps[m]
    corner = views.detector_centers[m] - (n_u - 1) / 2 * u_step - (n_v - 1) / 2 * v_step
    if not views.parallel:
        return Fan(views.sources[m], corner, v_step, u_step, views.shape)
    direction = views.detector_centers[m] - views.sources[m]
    if grid is None:
        return Fan(corner - direction, corner, v_step, u_step, views.shape, parallel=True)
    direction = direction / np.linalg.norm(direction)
    outermost = [corner + i * (n_v - 1) * v_step + j * (n_u - 1) * u_step for i in (0, 1) for j in (0, 1)]
    distances = (grid.corners()[:, None] - outermost) @ direction  # from pixels to the grid
    margin = float(grid.spacing.max() + np.linalg.norm(u_step) + np.linalg.norm(v_step))
    first, last = (corner + distance * direction for distance in (distances.min() - margin, distances.max() + margin))
    return Fan(first, last, v_step, u_step, views.shape, parallel=True)


@dataclass(frozen=True, eq=False)
class Ends:
    """Rays from point to point: N rows of one ray."""

    starts: Floats
    """(N, 3), starts of the rays, world mm."""
    ends: Floats
    """(N, 3), ends of the rays, world mm."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns, (N, 1)."""
        return len(self.ends), 1


def _targets(vectors: Floats, shape: tuple[int, int]) -> Floats:
    """Return the ends of the rays of fans (F, 4, 3), one fan after the other, (F * rows * columns, 3)."""
    row, column = (np.arange(n, dtype=np.float64) for n in shape)
    corner, row_step, column_step = vectors[:, 1:, None, None].swapaxes(0, 1)
    return (corner + row[:, None, None] * row_step + column[:, None] * column_step).reshape(-1, 3)


def window(fans: Sequence[Fan], points: Floats) -> tuple[slice, slice]:
    """Return the rows and columns outside of which no ray of any of `fans` meets the convex hull of `points`.

    Parameters
    ----------
    fans
        Fans of one shape.
    points
        Points (P, 3), world mm.
    """
    shape = fans[0].shape
    source, corner, row_step, column_step = np.concatenate([fan.vectors() for fan in fans]).swapaxes(0, 1)
    to_corner = corner - source
    # point - source = w (i row_step + j column_step + to_corner), solved for w i, w j and w by Cramer's rule. LAPACK's
    # threads would go on waiting, busily, beside ours.
    pairs = (column_step, to_corner), (to_corner, row_step), (row_step, column_step)
    normals = np.stack([np.cross(a, b) for a, b in pairs])
    w_row, w_column, w = np.einsum("kfi,fpi->kfp", normals, points - source[:, None])
    volume = np.einsum("fi,fi->f", row_step, normals[0])[:, None]
    parallel = fans[0].parallel
    w = parallel + (1 - parallel) * w / volume  # size of a step at the point, where the sources move too
    if not (w > 1e-6 * np.abs(w).max(axis=1, keepdims=True)).all():  # a point lies beside or behind a source
        return slice(0, shape[0]), slice(0, shape[1])
    slices = []
    for positions, n in ((w_row / volume / w, shape[0]), (w_column / volume / w, shape[1])):
        first, last = positions.min() - 0.01, positions.max() + 0.01  # a little more than rounding
        start = int(np.clip(np.ceil(first), 0, n))
        slices.append(slice(start, int(np.clip(np.floor(last) + 1, start, n))))
    return slices[0], slices[1]


@dataclass(frozen=True, eq=False)
class IndexRays:
    """Rays in index space, where voxel i of an axis fills [i, i + 1) and the faces lie at 0, 1, ..., n.

    A point of ray r is ``starts[r] + alpha * directions[r]``, alpha from 0 (source) to 1 (target).
    """

    starts: Floats
    """(N, 3), sources, voxels."""
    directions: Floats
    """(N, 3), vectors from source to target, voxels; a component is either exactly 0 or larger than 1e-9 in size."""
    lengths: Floats
    """(N,), distances from source to target, mm: ``lengths[r] * (alpha_2 - alpha_1)`` is the length of a segment."""

    def __len__(self) -> int:
        return len(self.lengths)

    def listed(self) -> IndexRays:
        """Return these rays, which are listed one by one."""
        return self


@dataclass(frozen=True, eq=False)
class IndexFans:
    """Fans of one shape in index space, the rays of each after those of the fan before: `IndexRays` not yet listed."""

    table: Floats
    """(F, 8, 3), source, corner, row step and column step of each fan in index space, not snapped; the same in world mm."""
    shape: tuple[int, int]
    """Number of rows and columns."""
    parallel: float = 0.0
    """`Fan.parallel`; the backend cuda takes 0 and 1 alone."""

    def __len__(self) -> int:
        return len(self.table) * self.shape[0] * self.shape[1]

    def listed(self) -> IndexRays:
        """Return the rays one by one, snapped to the planes that they lie in."""
        ends = _targets(self.table[:, :4], self.shape)
        starts, sources = (_targets(self._source_vectors(k), self.shape) for k in (0, 4))
        mm = _targets(self.table[:, 4:], self.shape) - sources
        return _snapped(starts, ends, np.linalg.norm(mm, axis=1))

    def _source_vectors(self, first: int) -> Floats:
        """Return the vectors (F, 4, 3) of fans whose ends are the sources, in index space (`first` 0) or world mm (4)."""
        vectors = self.table[:, first : first + 4].copy()
        vectors[:, 1] = vectors[:, 0]
        vectors[:, 2:] *= self.parallel
        return vectors


Rays = IndexRays | IndexFans


@dataclass(frozen=True, eq=False)
class Attenuation:
    """Attenuation of rays between each point and their source."""

    mu: Any
    """(n_x, n_y, n_z), attenuation coefficients, 1/mm, of the backend's kind; 0 outside."""
    rays: Rays | None = None
    """Rays of the line integrals in the index space of mu; None if mu shares the volume's lattice."""


def index_fans(
    grid: Grid, vectors: Floats, shape: tuple[int, int], parallel: float = 0.0, origin: tuple[int, int, int] = (0, 0, 0)
) -> IndexFans:
    """Return fans, (F, 4, 3) of `Fan.vectors` in world mm, in the index space of `grid`, as `index_rays` does rays."""
    affine = _index_from_world(grid, origin)
    table = np.empty((len(vectors), 8, 3))
    table[:, 4:] = vectors
    table[:, :4] = np.einsum("fvi,ji->fvj", vectors, affine[:3, :3])
    table[:, :2] += affine[:3, 3]
    return IndexFans(table, shape, parallel)


def index_rays(grid: Grid, sources: Floats, targets: Floats, origin: tuple[int, int, int] = (0, 0, 0)) -> IndexRays:
    """Return rays from `sources` to `targets`, both (N, 3) in world mm, in the index space of `grid`.

    A ray that lies in a plane of voxel faces belongs to the voxels above it (half-open voxels), in every
    backend and on rotated grids too: its coordinate is snapped to the integer. On the grid's upper outer face
    it therefore misses.

    Parameters
    ----------
    origin
        Voxel whose lower corner has the index (0, 0, 0): not 0 for a volume cropped from the grid.
    """
    affine = _index_from_world(grid, origin)
    linear, translation = affine[:3, :3], affine[:3, 3]
    # einsum, not `@`: BLAS would start threads of its own inside ours.
    starts = np.einsum("ni,ji->nj", sources, linear) + translation
    ends = np.einsum("ni,ji->nj", targets, linear) + translation
    return _snapped(starts, ends, np.linalg.norm(targets - sources, axis=1))


def _index_from_world(grid: Grid, origin: tuple[int, int, int]) -> Floats:
    """Return the matrix (4, 4) from world mm to the index space of `IndexRays`."""
    affine = grid.index_from_world.copy()
    # An integer index is a voxel's centre in `grid`, and its lower face here.
    affine[:3, 3] += 0.5 - np.asarray(origin, dtype=np.float64)
    return affine


def _snapped(starts: Floats, ends: Floats, lengths: Floats) -> IndexRays:
    """Return rays from `starts` to `ends` in index space, snapped to planes of voxel faces that they lie in."""
    planes = np.rint(starts)
    in_plane = (np.abs(starts - planes) <= SNAP) & (np.abs(ends - planes) <= SNAP)
    starts = np.where(in_plane, planes, starts)
    directions = ends - starts
    # A component this small crosses no plane (both ends would be within SNAP of it), so it may as well be 0, and backends
    # divide by components that are not 0 without overflow.
    directions[in_plane | (np.abs(directions) <= SNAP)] = 0.0
    return IndexRays(starts, directions, lengths)
