"""Transmittance from the voxels of a grid to a pinhole, for models without rays."""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import Array, Floats
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..rays import backends
from ..rays.bundles import Beam, Bundles, RayBundle
from ..rays.execution import Execution
from ..rays.lattices import rounded_up
from ..rays.ray_geometry import Fan
from ..rays.tracing import fan_gradient
from ..volumes.volume import Volume

# Rays across a voxel, where that is farthest and looks narrowest. Across a voxel of mu there are at least as many as its
# edges need, and at most as many as they show; but a ray meets every voxel, since a lattice's holes are sqrt(2) times its
# step wide.
_RAYS_ACROSS, _RAYS_ACROSS_MU, _RAYS_TO_MEET = 4, (1.5, 6), math.sqrt(2)
# Slope by which rays are cast beyond the outermost pixels: their lattice is turned by up to 1/2 % from the module.
_TURN_MARGIN = 0.015
# Slope by which the lattice of rays is turned: no edges of voxels run along it, so they meet the rays at many different
# places.
_LATTICE_SLOPE = (math.sqrt(5) - 1) / 2


class ArrayOnGrid(NamedTuple):
    """Array of any type with its grid; a `Volume` has the same fields, but always float32."""

    array: Array
    grid: Grid


@dataclass(frozen=True, eq=False)
class VoxelTransmittance:
    """Transmittance from each voxel of a box of a grid to the pinhole of view m, by a fan of rays."""

    mu: Volume | ArrayOnGrid
    """Attenuation coefficients, 1/mm."""
    grid: Grid
    """Grid of all voxels; the rays depend on it."""
    box: Grid
    """Grid of the voxels whose transmittance is computed."""
    views: Views
    """The views."""
    m: int
    """Number of the view."""
    frame: Floats
    """(3, 3), u, v and k of its module."""
    margin: float
    """Slope by which rays are cast beyond the outermost pixels: mm per mm of depth."""
    dtype: type
    """Type of the numbers, numpy's float32 or float64."""

    @functools.cached_property
    def _rays(self) -> tuple[Floats, Bundles, Execution]:
        """Weights of 1 of the rays, (1, rows, columns), the rays, and the execution that traces them.

        The rays move with the pinhole, but stay as they are when the module turns a little: the transmittance does not
        depend on that.
        """
        views, m, grid, pinhole = self.views, self.m, self.grid, self.views.sources[self.m]
        v, k = np.round(self.frame[1:], 2)
        u = np.cross(v, k) / np.linalg.norm(np.cross(v, k))
        k /= np.linalg.norm(k)
        frame = np.stack([u, np.cross(k, u), k])
        detector_sides = np.stack([views.v_steps[m] * views.shape[0], views.u_steps[m] * views.shape[1]])
        detector_center = frame @ (views.detector_centers[m] - pinhole)
        far = rounded_up(float(((grid.corners() - pinhole) @ k).max()))
        margin = 2 * round(self.margin + _TURN_MARGIN, 2)
        sides = far * (np.linalg.norm(detector_sides, axis=1) / detector_center[2] + margin)
        widths = (np.linalg.svd(frame[:2] @ g.affine[:3, :3], compute_uv=False)[-1] for g in (grid, self.mu.grid))
        (width, mu_width), (lower, upper) = map(float, widths), _RAYS_ACROSS_MU
        step = max(min(width / _RAYS_ACROSS, mu_width / lower), min(width / _RAYS_TO_MEET, mu_width / upper))
        turn = np.array([[1, _LATTICE_SLOPE], [-_LATTICE_SLOPE, 1]]) / math.hypot(1, _LATTICE_SLOPE)
        rows, columns = np.ceil(np.abs(turn) @ sides / step).astype(int).tolist()
        row_step, column_step = step * turn @ frame[1::-1]
        corner = far * np.round(detector_center / detector_center[2], 2) @ frame
        corner -= (rows - 1) / 2 * row_step + (columns - 1) / 2 * column_step
        fan = Fan(pinhole, pinhole + corner, row_step, column_step, (rows, columns))
        bundle = RayBundle.along(self.box, Beam(fan))
        execution = Execution(backends.choose("auto"), self.box, self.mu.grid, self.dtype is np.float64)
        return np.ones((1, rows, columns), self.dtype), Bundles(1, lambda _: bundle), execution

    @property
    def _mu_array(self) -> Array:
        """Attenuation coefficients as numbers of `dtype`, 1/mm."""
        return np.asarray(self.mu.array.astype(self.dtype, copy=False))

    @functools.cached_property
    def _chords(self) -> Array:
        """Sum of the rays' chords through each voxel, mm."""
        ones, bundles, execution = self._rays
        return np.asarray(execution.backproject(ones, bundles))

    @functools.cached_property
    def transmittance(self) -> Array:
        """Mean over each voxel of ``exp(-integral of mu)`` from there to the pinhole, ``box.shape``.

        The mean over the chord of every ray through a voxel is exact; that over the voxel is the mean over the rays that
        meet it, weighted by their chords, up to 16 where it is farthest. Voxels that no ray meets get 0.
        """
        ones, bundles, execution = self._rays
        return self._by_chords(np.asarray(execution.backproject(ones, bundles, self._mu_array)))

    def _by_chords(self, values: Array) -> Array:
        """Return `values` divided by the voxels' chords, 0 where no ray meets a voxel."""
        chords = self._chords
        return np.divide(values, chords, out=np.zeros(chords.shape, self.dtype), where=chords > 0)

    def pinhole_gradient(self, d_transmittance: Array) -> Floats:
        """Return the gradient by the pinhole's position (3,), with which the rays move, from that by the transmittance."""
        _, bundles, execution = self._rays
        d_fan = fan_gradient(execution, bundles, self._by_chords(d_transmittance), self._mu_array)
        d_fan -= fan_gradient(execution, bundles, self._by_chords(d_transmittance * self.transmittance), None)
        return d_fan[0] + d_fan[1]

    def mu_gradient(self, d_transmittance: Array) -> Array:
        """Return the gradient by mu, on its whole grid, from that by the transmittance."""
        ones, bundles, execution = self._rays
        return np.asarray(execution.mu_gradient(ones, bundles, self._by_chords(d_transmittance), self._mu_array))
