"""The model of a sum along rays that weights voxels with the sensitivity to a point source; it is no number of counts."""

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
    """Sum of Siddon's segments along each ray times ``d^2 sin^3(theta) / (16 h^2)``, a point source's sensitivity.

    It is the sum over voxels of value x length of the ray in it x sensitivity, with theta the ray's elevation over the
    pinhole's plane and h the height of the voxel's centre over it; voxels at or behind the plane have no weight. It is for
    comparison with programs that weight each segment with 1/h^2.

    No camera counts like that. The density of a pixel grid's rays already falls as 1/h^2: a point source farther away
    covers fewer pixels. Weighting the segments with 1/h^2 again makes the total counts of a point source fall as 1/h^4,
    and far parts of an object too dark by (h_near / h_far)^2. `Emission` follows the law of the pinhole.
    """

    system: PinholeSystem
    """Modules, as many as the views and in their order."""

    name = "inverse square sum"
    weights_voxels = True

    def __post_init__(self) -> None:
        instance(self.system, PinholeSystem, "inverse square sum")

    def of_views(self, which: NDArray[np.integer]) -> Self:
        """Return the model of the modules `which` alone, indices from 0."""
        return replace(self, system=self.system[which])

    def check(self, views: Views) -> None:
        """Raise `InputError` unless `views` are of this system."""
        require_views_of(self.system, views, self.name)

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Yield the rays of view m, weighted with ``d^2 sin^3(theta) / 16``."""
        rays, k = view_rays(views, m), self.system.frames()[m, 2]
        directions = rays.targets() - rays.source
        sine = (directions @ k / np.linalg.norm(directions, axis=1)).reshape(views.shape)
        weights = self.system.pinhole_diameter[m] ** 2 / 16 * sine**3
        yield Beam(rays, lambda rows, columns, shifts: weights[None, rows, columns])

    def voxel_weights(self, views: Views, m: int, grid: Grid) -> Floats:
        """Return ``1 / h^2`` at the voxels' centres, 1/mm^2, 0 at or behind the pinhole's plane."""
        k = self.system.frames()[m, 2]
        x, y, z = (k @ grid.affine[:3, axis] * np.arange(n) for axis, n in enumerate(grid.shape))
        height = k @ (grid.affine[:3, 3] - views.sources[m]) + x[:, None, None] + y[:, None] + z
        return np.divide(1, height**2, out=np.zeros(grid.shape), where=height > 0)
