"""The one place where rays go from world mm into index space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.grid import Grid

# Rounding moves a coordinate by some 1e-12 voxels (a rotated grid, a source thousands of voxels away). A ray
# this close to a plane of voxel faces along its whole way lies in the plane; one this steady along an axis is
# parallel to its planes.
SNAP = 1e-9


_UNSHIFTED = np.zeros((1, 2))


@dataclass(frozen=True, eq=False)
class Fan:
    """Rays from one point to the points of a lattice on a plane, world mm: all that an image's rays are.

    Ray j of line i goes from `source` to ``corner + i line_step + j ray_step``; with S shifts there are S such lattices,
    each moved by so many lines and rays: more points of every pixel.

    Attributes
    ----------
    source, corner, line_step, ray_step : array (3,)
        mm.
    shape : tuple of int
        Lines, and rays of a line.
    shifts : array (S, 2)
        In lines and in rays.
    """

    source: NDArray[np.float64]
    corner: NDArray[np.float64]
    line_step: NDArray[np.float64]
    ray_step: NDArray[np.float64]
    shape: tuple[int, int]
    shifts: NDArray[np.float64] = field(default_factory=lambda: _UNSHIFTED)

    def __len__(self) -> int:
        return len(self.shifts) * self.shape[0] * self.shape[1]

    def __getitem__(self, which: slice | tuple[slice, slice] | tuple[slice, slice, slice]) -> Fan:
        """Some of the lines, or of each of these some of the rays, or of these some of the shifts."""
        lines, rays, shifts = ((*which, slice(None), slice(None)) if isinstance(which, tuple) else (which, *_ALL))[:3]
        line, last_line, _ = lines.indices(self.shape[0])
        ray, last_ray, _ = rays.indices(self.shape[1])
        corner = self.corner + line * self.line_step + ray * self.ray_step
        return replace(self, corner=corner, shape=(last_line - line, last_ray - ray), shifts=self.shifts[shifts])

    def transposed(self) -> Fan:
        """The same rays, lines across."""
        shifts = self.shifts if self.shifts is _UNSHIFTED else self.shifts[:, ::-1]
        return Fan(self.source, self.corner, self.ray_step, self.line_step, self.shape[::-1], shifts)

    def lies_across(self, grid: Grid) -> bool:
        """Whether neighbours in the voxels' memory are rather neighbours in different lines than in one."""
        contiguous = grid.index_from_world[2, :3]
        return bool(abs(contiguous @ self.line_step) > abs(contiguous @ self.ray_step))

    def vectors(self) -> NDArray[np.float64]:
        """Source, corner, line step and ray step of the S lattices, (S, 4, 3)."""
        vectors = np.empty((len(self.shifts), 4, 3))
        vectors[:] = self.source, self.corner, self.line_step, self.ray_step
        if self.shifts is not _UNSHIFTED:
            vectors[:, 1] += self.shifts @ vectors[0, 2:]
        return vectors

    def targets(self) -> NDArray[np.float64]:
        """Ends of the rays (S * lines * rays, 3), shift by shift, line by line."""
        return _targets(self.vectors(), self.shape)


def _targets(vectors: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Ends of the rays of fans (F, 4, 3), one after the other, (F * lines * rays, 3)."""
    line, ray = (np.arange(n, dtype=np.float64) for n in shape)
    corner, line_step, ray_step = vectors[:, 1:, None, None].swapaxes(0, 1)
    return (corner + line[:, None, None] * line_step + ray[:, None] * ray_step).reshape(-1, 3)


_ALL = slice(None), slice(None)


def window(fans: Sequence[Fan], points: NDArray[np.float64]) -> tuple[slice, slice]:
    """The lines, and the rays of each, outside of which no ray of any of `fans` meets the convex hull of `points`.

    Parameters
    ----------
    fans
        Of one shape.
    points
        (P, 3), in the frame of the fans, mm.
    """
    shape = fans[0].shape
    source, corner, line_step, ray_step = np.concatenate([fan.vectors() for fan in fans]).swapaxes(0, 1)
    to_corner = corner - source
    # point - source = w (i line_step + j ray_step + to_corner), solved for w i, w j and w by Cramer's rule. Not by LAPACK,
    # whose threads would go on waiting, busily, beside ours.
    across = np.stack([np.cross(ray_step, to_corner), np.cross(to_corner, line_step), np.cross(line_step, ray_step)])
    w_line, w_ray, w = np.einsum("kfi,fpi->kfp", across, points - source[:, None])
    volume = np.einsum("fi,fi->f", line_step, across[0])[:, None]
    w = w / volume
    if not (w > 1e-6 * np.abs(w).max(axis=1, keepdims=True)).all():  # some of it beside or behind a source
        return slice(0, shape[0]), slice(0, shape[1])
    windows = []
    for places, n in ((w_line / volume / w, shape[0]), (w_ray / volume / w, shape[1])):
        first, last = places.min() - 0.01, places.max() + 0.01  # a little more than rounding
        start = int(np.clip(np.ceil(first), 0, n))
        windows.append(slice(start, int(np.clip(np.floor(last) + 1, start, n))))
    return windows[0], windows[1]


@dataclass(frozen=True, eq=False)
class IndexRays:
    """Rays in index space, where voxel i of an axis fills [i, i + 1) and the faces lie at 0, 1, ..., n.

    A point of ray r is ``starts[r] + alpha * directions[r]``, alpha from 0 (source) to 1 (target).

    Attributes
    ----------
    starts : float64 array (N, 3)
        Sources, voxels.
    directions : float64 array (N, 3)
        Source to target, voxels; a component is either exactly 0 or larger than 1e-9 in size.
    lengths : float64 array (N,)
        Source to target, mm: ``lengths[r] * (alpha_2 - alpha_1)`` is the length of a segment.
    """

    starts: NDArray[np.float64]
    directions: NDArray[np.float64]
    lengths: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, which: slice) -> IndexRays:
        """Some of the rays."""
        return IndexRays(self.starts[which], self.directions[which], self.lengths[which])

    def listed(self) -> IndexRays:
        """These rays."""
        return self


@dataclass(frozen=True, eq=False)
class IndexFans:
    """Fans of one shape in index space, the rays of each behind those of the one before: `IndexRays`, yet to be listed.

    Attributes
    ----------
    table : array (F, 8, 3)
        Source, corner, line step and ray step of each in index space, where nothing is snapped yet; the same in world mm.
    shape : tuple of int
        Lines, and rays of a line.
    """

    table: NDArray[np.float64]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.table) * self.shape[0] * self.shape[1]

    def listed(self) -> IndexRays:
        """The rays one by one, snapped to the planes that they lie in."""
        of_each = self.shape[0] * self.shape[1]
        starts, sources = (np.repeat(self.table[:, k], of_each, axis=0) for k in (0, 4))
        ends, targets = (_targets(self.table[:, k : k + 4], self.shape) for k in (0, 4))
        return _snapped(starts, ends, np.linalg.norm(targets - sources, axis=1))


Rays = IndexRays | IndexFans


@dataclass(frozen=True, eq=False)
class Attenuation:
    """What weakens rays between each point and their source.

    Attributes
    ----------
    mu : array or tensor (n_x, n_y, n_z)
        Attenuation coefficients, 1/mm, of the backend's kind; outside they are 0.
    rays : IndexRays, IndexFans or None
        The same rays in mu's own index space; None where mu shares the volume's lattice.
    """

    mu: Any
    rays: Rays | None = None

    def listed(self) -> Attenuation:
        """The same with its rays one by one."""
        return self if self.rays is None else Attenuation(self.mu, self.rays.listed())


@dataclass(frozen=True, eq=False)
class RayMapper:
    """Rays from world mm into the index spaces of a volume and of what attenuates them.

    Attributes
    ----------
    grid : Grid
        The volume's.
    origin : tuple of int
        Voxel of `grid` at which the backend's array begins.
    mu : array or tensor, optional
        What attenuates the rays, on `mu_grid` from voxel `mu_origin` on, or on the volume's own lattice if that is None.
    """

    grid: Grid
    origin: tuple[int, int, int] = (0, 0, 0)
    mu: Any = None
    mu_grid: Grid | None = None
    mu_origin: tuple[int, int, int] = (0, 0, 0)

    def __call__(self, *fans: Fan) -> tuple[IndexFans, Attenuation | None]:
        """The rays of fans of one shape, those of each behind those of the one before, and what attenuates them."""
        vectors = fans[0].vectors() if len(fans) == 1 else np.concatenate([fan.vectors() for fan in fans])
        return self._mapped(index_fans, vectors, fans[0].shape)

    def between(
        self, sources: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> tuple[IndexRays, Attenuation | None]:
        """The rays from `sources` to `targets`, both (N, 3) in world mm, and what attenuates them."""
        return self._mapped(index_rays, sources, targets)

    def _mapped(self, mapped: Callable[..., Any], *rays: Any) -> tuple[Any, Attenuation | None]:
        """`rays`, as `index_fans` or `index_rays` takes them between grid and origin."""
        attenuation = None
        if self.mu is not None:
            mu_rays = None if self.mu_grid is None else mapped(self.mu_grid, *rays, self.mu_origin)
            attenuation = Attenuation(self.mu, mu_rays)
        return mapped(self.grid, *rays, self.origin), attenuation


def index_fans(
    grid: Grid, vectors: NDArray[np.float64], shape: tuple[int, int], origin: tuple[int, int, int] = (0, 0, 0)
) -> IndexFans:
    """Fans (F, 4, 3) in world mm, as of `Fan.vectors`, in `grid`'s index space; see `index_rays`."""
    affine = _index_from_world(grid, origin)
    table = np.empty((len(vectors), 8, 3))
    table[:, 4:] = vectors
    table[:, :4] = np.einsum("fvi,ji->fvj", vectors, affine[:3, :3])
    table[:, :2] += affine[:3, 3]
    return IndexFans(table, shape)


def index_rays(
    grid: Grid,
    sources: NDArray[np.float64],
    targets: NDArray[np.float64],
    origin: tuple[int, int, int] = (0, 0, 0),
) -> IndexRays:
    """Rays from `sources` to `targets`, both (N, 3) in world mm, in `grid`'s index space.

    A ray that lies in a plane of voxel faces belongs to the voxels above it (half-open voxels), in every
    backend and on rotated grids too: its coordinate is snapped to the integer. On the grid's upper outer face
    it therefore misses.

    Parameters
    ----------
    origin
        The voxel whose lower corner is to be index (0, 0, 0): not 0 for a volume cropped from the grid.
    """
    affine = _index_from_world(grid, origin)
    linear, translation = affine[:3, :3], affine[:3, 3]
    # Not `@`: BLAS would start threads of its own inside ours.
    starts = np.einsum("ni,ji->nj", sources, linear) + translation
    ends = np.einsum("ni,ji->nj", targets, linear) + translation
    return _snapped(starts, ends, np.linalg.norm(targets - sources, axis=1))


def _index_from_world(grid: Grid, origin: tuple[int, int, int]) -> NDArray[np.float64]:
    """World mm to the index space of `IndexRays`, (4, 4)."""
    affine = grid.index_from_world.copy()
    # The integer index is a voxel's centre in world coordinates, and its lower face here.
    affine[:3, 3] += 0.5 - np.asarray(origin, dtype=np.float64)
    return affine


def _snapped(starts: NDArray[np.float64], ends: NDArray[np.float64], lengths: NDArray[np.float64]) -> IndexRays:
    planes = np.rint(starts)
    in_plane = (np.abs(starts - planes) <= SNAP) & (np.abs(ends - planes) <= SNAP)
    starts = np.where(in_plane, planes, starts)
    directions = ends - starts
    # What is left of nearly 0 crosses no plane (both ends would be within SNAP of it), so 0 is as good:
    # backends may divide by what is not 0 without overflow.
    directions[in_plane | (np.abs(directions) <= SNAP)] = 0.0
    return IndexRays(starts, directions, lengths)
