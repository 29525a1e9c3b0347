"""The one place where rays go from world mm into index space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..grid import Grid

# Rounding moves a coordinate by some 1e-12 voxels (a rotated grid, a source thousands of voxels away). A ray
# this close to a plane of voxel faces along its whole way lies in the plane; one this steady along an axis is
# parallel to its planes.
_SNAP = 1e-9


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


@dataclass(frozen=True, eq=False)
class Attenuation:
    """What weakens rays between each point and their source.

    Attributes
    ----------
    mu : array or tensor (n_x, n_y, n_z)
        Attenuation coefficients, 1/mm, of the backend's kind; outside they are 0.
    rays : IndexRays
        The rays in mu's own index space. The very object that is given for the volume where mu shares the volume's
        lattice.
    """

    mu: Any
    rays: IndexRays


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

    def __call__(
        self, sources: NDArray[np.float64], targets: NDArray[np.float64]
    ) -> tuple[IndexRays, Attenuation | None]:
        """Rays from `sources` to `targets`, both (N, 3) in world mm."""
        rays = index_rays(self.grid, sources, targets, self.origin)
        if self.mu is None:
            return rays, None
        if self.mu_grid is None:
            return rays, Attenuation(self.mu, rays)
        return rays, Attenuation(self.mu, index_rays(self.mu_grid, sources, targets, self.mu_origin))


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
    linear = np.linalg.inv(grid.affine[:3, :3]).T
    # The integer index is a voxel's centre in world coordinates, and its lower face here.
    shift = 0.5 - np.asarray(origin, dtype=np.float64)
    translation = grid.affine[:3, 3]
    # Not `@`: BLAS would start threads of its own inside ours.
    starts = np.einsum("ni,ij->nj", sources - translation, linear) + shift
    ends = np.einsum("ni,ij->nj", targets - translation, linear) + shift

    planes = np.rint(starts)
    in_plane = (np.abs(starts - planes) <= _SNAP) & (np.abs(ends - planes) <= _SNAP)
    np.copyto(starts, planes, where=in_plane)
    directions = ends - starts
    # What is left of nearly 0 crosses no plane (both ends would be within _SNAP of it), so 0 is as good:
    # backends may divide by what is not 0 without overflow.
    directions[in_plane | (np.abs(directions) <= _SNAP)] = 0.0
    return IndexRays(starts, directions, np.linalg.norm(targets - sources, axis=1))
