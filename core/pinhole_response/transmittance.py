"""Shares of photons that reach a pinhole from every voxel of a grid, for models without rays."""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Floats
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..rays import backends
from ..rays.bundles import Beam, Bundle, Bundles
from ..rays.execution import Execution
from ..rays.lattices import rounded_up
from ..rays.ray_geometry import Fan
from ..rays.tracing import gradient_by_fans
from ..volumes.volume import Volume

# Rays across a voxel, where that is farthest and looks narrowest. Across a voxel of mu there are not fewer than its edges
# need, nor more than they show; but a ray meets every voxel, since a lattice's holes are sqrt(2) times its step wide.
_RAYS_ACROSS, _RAYS_ACROSS_MU, _RAYS_TO_MEET = 4, (1.5, 6), math.sqrt(2)
# What rays are cast beyond the outermost pixels, as a slope, since their lattice is turned by up to 1/2 % from the module.
_TURNED = 0.015
# The rays' lattice is turned by this slope, along which no edges of voxels run: they meet the rays at many different places.
_SLOPE = (math.sqrt(5) - 1) / 2


class Field(NamedTuple):
    """Numbers on a grid, of any type; a `Volume` has the same fields, and float32."""

    array: Array
    grid: Grid


@dataclass(frozen=True, eq=False)
class VoxelRays:
    """Rays from view m's pinhole through all voxels of a part of a grid.

    Attributes
    ----------
    mu
        What attenuates, 1/mm.
    grid, part
        All voxels, which say where the rays run, and those that are looked at.
    views, m, frame
        The view, and its module's u, v, k.
    margin
        How far beyond the outermost pixels rays are cast, as a slope: mm per mm of depth.
    kind
        The numbers' type, numpy's float32 or float64.
    """

    mu: Volume | Field
    grid: Grid
    part: Grid
    views: Views
    m: int
    frame: Floats
    margin: float
    kind: type

    @functools.cached_property
    def _rays(self) -> tuple[Floats, Bundles, Execution]:
        """A weight of 1 for each ray, (1, rows, columns); the rays; and what computes with them.

        They go with the pinhole, but stay as they are when the module turns a little: what passes does not depend on it.
        """
        views, m, grid, pinhole = self.views, self.m, self.grid, self.views.sources[self.m]
        v, k = np.round(self.frame[1:], 2)
        u = np.cross(v, k) / np.linalg.norm(np.cross(v, k))
        k /= np.linalg.norm(k)
        frame = np.stack([u, np.cross(k, u), k])
        across = np.stack([views.v_steps[m] * views.shape[0], views.u_steps[m] * views.shape[1]])
        middle = frame @ (views.detector_centers[m] - pinhole)
        far = rounded_up(float(((grid.corners() - pinhole) @ k).max()))
        margin = 2 * round(self.margin + _TURNED, 2)
        sides = far * (np.linalg.norm(across, axis=1) / middle[2] + margin)
        each = (np.linalg.svd(frame[:2] @ g.affine[:3, :3], compute_uv=False)[-1] for g in (grid, self.mu.grid))
        (width, mu_width), (fewest, most) = map(float, each), _RAYS_ACROSS_MU
        step = max(min(width / _RAYS_ACROSS, mu_width / fewest), min(width / _RAYS_TO_MEET, mu_width / most))
        turned = np.array([[1, _SLOPE], [-_SLOPE, 1]]) / math.hypot(1, _SLOPE)
        rows, columns = np.ceil(np.abs(turned) @ sides / step).astype(int).tolist()
        row_step, column_step = step * turned @ frame[1::-1]
        corner = far * np.round(middle / middle[2], 2) @ frame
        corner -= (rows - 1) / 2 * row_step + (columns - 1) / 2 * column_step
        fan = Fan(pinhole, pinhole + corner, row_step, column_step, (rows, columns))
        bundle = Bundle.along(self.part, Beam(fan))
        execution = Execution(backends.choose("auto"), self.part, self.mu.grid, self.kind is np.float64)
        return np.ones((1, rows, columns), self.kind), Bundles(1, lambda _: bundle), execution

    @property
    def _mu_array(self) -> Array:
        return np.asarray(self.mu.array.astype(self.kind, copy=False))

    @functools.cached_property
    def _chords(self) -> Array:
        """The sums of the rays' chords through each voxel, mm."""
        ones, bundles, execution = self._rays
        return np.asarray(execution.backproject(ones, bundles))

    @functools.cached_property
    def passing(self) -> Array:
        """The mean over each voxel of ``exp(-integral of mu)`` from there to the pinhole, ``part.shape``.

        The mean over the chord of every ray through a voxel is exact; that over the voxel is the mean over the rays that
        meet it, weighted by their chords, up to 16 where it is farthest. Voxels that no ray meets get 0.
        """
        ones, bundles, execution = self._rays
        passing = np.asarray(execution.backproject(ones, bundles, self._mu_array))
        return self._by_chords(passing)

    def _by_chords(self, values: Array) -> Array:
        chords = self._chords
        return np.divide(values, chords, out=np.zeros(chords.shape, self.kind), where=chords > 0)

    def gradient(self, by_passing: Array) -> Floats:
        """Derivatives by the pinhole's place (3,), with which the rays go, from those by `passing`."""
        _, bundles, execution = self._rays
        whole = gradient_by_fans(execution, bundles, self._by_chords(by_passing), self._mu_array)
        whole -= gradient_by_fans(execution, bundles, self._by_chords(by_passing * self.passing), None)
        return whole[0] + whole[1]

    def mu_gradient(self, by_passing: Array) -> Array:
        """Derivatives by mu, on its whole grid, from those by `passing`."""
        ones, bundles, execution = self._rays
        return np.asarray(execution.mu_gradient(ones, bundles, self._by_chords(by_passing), self._mu_array))
