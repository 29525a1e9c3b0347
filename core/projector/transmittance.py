"""Shares of photons that reach a pinhole from every voxel of a grid, for models without rays."""

import math

import numpy as np

from ..arrays import Floats, Floats32
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..volumes.volume import Volume
from . import backends
from .bundles import Beam, Bundle, Bundles
from .execution import Execution
from .rays import Fan

# Rays across a voxel, where that is farthest and looks narrowest. Across a voxel of mu there are not fewer than its edges
# need, nor more than they show.
_RAYS_ACROSS, _RAYS_ACROSS_MU = 4, (1.5, 6)
# The rays' lattice is turned by this slope, along which no edges of voxels run: they meet the rays at many different places.
_SLOPE = (math.sqrt(5) - 1) / 2


def mean_transmittance(
    mu: Volume, grid: Grid, part: Grid, views: Views, m: int, frame: Floats, margin: float
) -> Floats32:
    """The mean over each voxel of a `part` of `grid` of ``exp(-integral of mu)`` from there to the pinhole, ``part.shape``.

    The mean over the chord of every ray through a voxel is exact; that over the voxel is the mean over the rays that meet
    it, weighted by their chords, up to 16 where it is farthest.

    Parameters
    ----------
    mu
        What attenuates, 1/mm.
    grid, part
        All voxels, which say where the rays run, and those of which it is.
    views, m, frame
        The view, and its module's u, v, k.
    margin
        How far beyond the outermost pixels rays are cast, as a slope: mm per mm of depth. Voxels that no ray meets get 0.
    """
    pinhole, k = views.sources[m], frame[2]
    across = np.stack([views.v_steps[m] * views.shape[0], views.u_steps[m] * views.shape[1]])
    middle = views.detector_centers[m] - pinhole
    far = float(((grid.corners() - pinhole) @ k).max())
    sides = far * (np.linalg.norm(across, axis=1) / (middle @ k) + 2 * margin)
    width, mu_width = (np.linalg.svd(frame[:2] @ g.affine[:3, :3], compute_uv=False)[-1] for g in (grid, mu.grid))
    fewest, most = _RAYS_ACROSS_MU
    step = max(min(width / _RAYS_ACROSS, mu_width / fewest), min(width, mu_width / most))
    turned = np.array([[1, _SLOPE], [-_SLOPE, 1]]) / math.hypot(1, _SLOPE)
    rows, columns = np.ceil(np.abs(turned) @ sides / step).astype(int).tolist()
    row_step, column_step = step * turned @ frame[1::-1]
    corner = pinhole + far / (middle @ k) * middle - (rows - 1) / 2 * row_step - (columns - 1) / 2 * column_step
    bundle = Bundle.along(part, Beam(Fan(pinhole, corner, row_step, column_step, (rows, columns))))
    execution = Execution(backends.choose("auto"), part, mu.grid)
    rays, bundles = np.ones((1, rows, columns), np.float32), Bundles(1, lambda _: bundle)
    chords = np.asarray(execution.backproject(rays, bundles))
    passing = np.asarray(execution.backproject(rays, bundles, mu.array))
    return np.divide(passing, chords, out=np.zeros(part.shape, np.float32), where=chords > 0)
