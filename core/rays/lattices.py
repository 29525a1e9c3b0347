"""Lattices of a volume and of mu, cropped to their filled parts, and rays in their index spaces."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, Floats, cropped
from ..errors import InputError
from ..geometry.grid import Grid
from .ray_geometry import Attenuation, Rays

Index = tuple[int, int, int]

# Largest relative change of a size that is rounded up.
_ROUNDING = 0.01


def rounded_up(size: float) -> float:
    """Return a size rounded up to one of a series in steps of 1 %: layouts made from it stay when a view moves a little."""
    return math.exp(math.ceil(math.log(size) / _ROUNDING) * _ROUNDING)


@dataclass(frozen=True, eq=False)
class Lattices:
    """A volume, its attenuation coefficients, and the index spaces of both."""

    grid: Grid
    """Grid of the volume."""
    volume: ArrayOrTensor = None
    """Part of the volume that is traced; None where a volume is yet to be filled."""
    origin: Index = (0, 0, 0)
    """Voxel of `grid` at which that part begins."""
    mu: ArrayOrTensor = None
    """Attenuation coefficients, 1/mm, on `mu_grid` from voxel `mu_origin` on; None without attenuation."""
    mu_grid: Grid | None = None
    """Grid of the attenuation coefficients; None if they are on the volume's own lattice."""
    mu_origin: Index = (0, 0, 0)
    """Voxel of `mu_grid` at which the part in `mu` begins."""

    def mapped(self, index: Callable[..., Rays], *rays: Any) -> tuple[Rays, Attenuation | None]:
        """Return rays in index space, ``index(grid, *rays, origin)``, and their attenuation; `index` makes fans or rays."""
        attenuation = None
        if self.mu is not None:
            mu_rays = None if self.mu_grid is None else index(self.mu_grid, *rays, self.mu_origin)
            attenuation = Attenuation(self.mu, mu_rays)
        return index(self.grid, *rays, self.origin), attenuation

    def corners(self) -> Floats:
        """Return the corners (8, 3), world mm, of the part of the grid that is traced."""
        grid = self.grid if self.volume is None else self.grid.box(self.origin, self.volume.shape)
        return grid.corners()


def filled_lattices(
    grid: Grid, volume: ArrayOrTensor, mu: ArrayOrTensor = None, mu_grid: Grid | None = None, whole_mu: bool = False
) -> Lattices:
    """Return the lattices of the parts of `volume` and of mu that are not empty.

    Empty margins cost time, and most objects fill a small part of their grid. With None (a volume yet to be filled)
    the volume's lattice is the whole grid. mu is cropped to where it is not 0, also outside the volume's filled part; with
    `whole_mu` it is not cropped.
    """
    box, origin, mu_origin = volume, (0, 0, 0), (0, 0, 0)
    if volume is not None:
        (box,), origin = cropped(volume)
    if mu is None:
        return Lattices(grid, box, origin)
    if mu_grid is None or same_lattice(mu_grid, grid):
        if volume is None or whole_mu:
            return Lattices(grid, volume, mu=mu)
        (common, mu_common), common_origin = cropped(volume, mu)
        # One lattice is traversed twice as fast as two, but two let rays that miss the volume's box stop at once.
        if math.prod(common.shape) <= 2 * math.prod(box.shape):
            return Lattices(grid, common, common_origin, mu_common)
    if not whole_mu:
        (mu,), mu_origin = cropped(mu)
    return Lattices(grid, box, origin, mu, mu_grid or grid, mu_origin)


def same_lattice(a: Grid, b: Grid) -> bool:
    """Return whether two grids are the same lattice, to the rounding of a file's float32 affine."""
    return a.shape == b.shape and np.allclose(a.corners(), b.corners(), rtol=0, atol=1e-4 * float(b.spacing.min()))


def require_no_negative(mu: ArrayOrTensor) -> ArrayOrTensor:
    """Return `mu`; raise `InputError` if a coefficient is negative."""
    if mu.min() < 0:
        raise InputError(f"mu: expected no negative coefficient, got {float(mu.min()):g} 1/mm")
    return mu
