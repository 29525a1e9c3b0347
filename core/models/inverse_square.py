"""A sum along rays that weights every voxel with the sensitivity to a point source; it is not a number of counts."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..rays.bundles import Beam
from ..rays.ray_geometry import view_rays
from ..validation import instance
from .model import Model, require_views_of


@dataclass(frozen=True, eq=False)
class InverseSquareSum(Model):
    """Siddon's segments times ``d^2 sin^3(theta) / (16 h^2)``, a point source's sensitivity, summed along each ray.

    The sum over voxels of value x length of the ray in it x sensitivity, with theta the ray's elevation over the
    pinhole's plane and h the height of the voxel's centre over it (voxels at or behind the plane count nothing). It is for
    comparison with programs that weight each segment with 1/h^2.

    It is not what a camera counts. The density of a pixel grid's rays already falls as 1/h^2: a point source farther away
    covers fewer pixels. Weighting the segments with 1/h^2 again makes the total counts of a point source fall as 1/h^4,
    and far parts of an object too dark by (h_near / h_far)^2. `Emission` follows the law of the pinhole.
    """

    system: PinholeSystem  # the modules, as many as the views and in their order

    name = "inverse square sum"
    weights_voxels = True

    def __post_init__(self) -> None:
        instance(self.system, PinholeSystem, "inverse square sum")

    def of_views(self, which: NDArray[np.integer]) -> Self:
        """The model of the modules `which` (indices) alone."""
        return replace(self, system=self.system[which])

    def check(self, views: Views) -> None:
        """Raise `InputError` unless `views` are of this system."""
        require_views_of(self.system, views, self.name)

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """The rays of `views`, weighted with ``d^2 sin^3(theta) / 16``."""
        rays, k = view_rays(views, m), self.system.frames()[m, 2]
        towards = rays.targets() - rays.source
        sine = (towards @ k / np.linalg.norm(towards, axis=1)).reshape(views.shape)
        weights = self.system.pinhole_diameter[m] ** 2 / 16 * sine**3
        yield Beam(rays, lambda rows, columns, shifts: weights[None, rows, columns])

    def voxel_weights(self, views: Views, m: int, grid: Grid) -> Floats:
        """``1 / h^2`` at the voxels' centres, 1/mm^2."""
        k = self.system.frames()[m, 2]
        along = [k @ grid.affine[:3, axis] * np.arange(n) for axis, n in enumerate(grid.shape)]
        height = k @ (grid.affine[:3, 3] - views.sources[m]) + along[0][:, None, None] + along[1][:, None] + along[2]
        return np.divide(1, height**2, out=np.zeros(grid.shape), where=height > 0)
