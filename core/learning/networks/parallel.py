"""Parallel projections inferred from what pinholes see, then filtered backprojection."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ...errors import InputError
from ...geometry.grid import Grid
from ...geometry.parallel_views import parallel_views
from ...projector import Projector
from ...reconstruction.ramp import ramp_matrix
from ..setup import Sample, Setup
from .network import Network, UNet, middle, positive, spread, surplus


class Model(Network):
    """A 2-D U-Net corrects parallel projections of the volume by OSEM; FBP makes the volume.

    It gets, of each projection and its neighbours in angle, those of the volumes by OSEM and of the EM update, which is what
    the counts say beyond them.

    Parameters
    ----------
    angles : int
        Of projections, over half a circle around z.
    neighbours : int
        On either side of a projection.
    channels : sequence of int
        Of each level of the U-Net.
    volumes : int
        By OSEM.
    """

    may_be_0 = ("neighbours",)

    def __init__(
        self, angles: int = 96, neighbours: int = 1, channels: Sequence[int] = (16, 32, 48), *, volumes: int = 3
    ):
        super().__init__()
        if neighbours > angles:
            raise InputError(f"network.neighbours: expected at most the {angles} angles, got {neighbours}")
        self.angles, self.neighbours = angles, neighbours
        self.net = UNet((volumes + 1) * (2 * neighbours + 1), 1, channels, dimensions=2)

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`."""
        beam, x = parallel_beam(setup.A.grid, self.angles), middle(sample)
        update = x * spread(setup, surplus(setup, sample, x))
        volumes = torch.cat([sample.osem, 5 * update], 1)
        images = beam.project(volumes) / beam.length  # (B, volumes + 1, angles, n_v, n_u)
        correction = self.net(self._stacks(images).flatten(0, 1)).view(len(x), self.angles, *images.shape[-2:])
        return [positive(beam.fbp(images[:, sample.osem.shape[1] // 2] + correction)[:, None] * beam.length)]

    def _stacks(self, images: Tensor) -> Tensor:
        """Projections and their neighbours as channels (B, angles, channels, n_v, n_u); half a circle on u is mirrored."""
        n = self.neighbours
        around = torch.cat([images[:, :, -n:].flip(-1), images, images[:, :, :n].flip(-1)], 2) if n else images
        return around.unfold(2, 2 * n + 1, 1).permute(0, 2, 1, 5, 3, 4).flatten(2, 3)


class ParallelBeam:
    """Projections along parallel rays at `angles` over half a circle around z, and FBP, both differentiable.

    Attributes
    ----------
    project : Projector
        Volumes (…, n_x, n_y, n_z) to line integrals (…, angles, n_v, n_u), value x mm.
    length : float
        The grid's width, mm: line integrals divided by it are about as large as the volume's values.
    """

    def __init__(self, grid: Grid, angles: int):
        corners = grid.corners()
        center, voxel = corners.mean(0), float(min(grid.spacing))
        self.pitch = voxel / 2, voxel  # of u, v: rays between voxels' centres too, which the adjoint needs to be even
        size = corners - center
        width, height = 2 * np.linalg.norm(size[:, :2], axis=1).max(), 2 * np.abs(size[:, 2]).max()
        shape = int(np.ceil(height / voxel - 1e-6)), int(np.ceil(2 * width / voxel))
        views = parallel_views(np.arange(angles) * np.pi / angles, shape, self.pitch, center=center)
        self.project, self.length = Projector(grid, views), float(width)
        # A voxel gets its volume by the pixel's area from each view; FBP takes 1 by the pitch of u, and the angle of a view.
        weight = np.pi / angles / self.pitch[0] * np.prod(self.pitch) / grid.voxel_volume
        self._filter = torch.as_tensor(ramp_matrix(shape[1], "ramp") * weight)

    def fbp(self, images: Tensor) -> Tensor:
        """Volumes (B, n_x, n_y, n_z) of line integrals (B, angles, n_v, n_u), backprojected by the projector's adjoint."""
        return self.project.T(images @ self._filter.to(images))


parallel_beam = lru_cache(maxsize=4)(ParallelBeam)
"""The `ParallelBeam` of a grid and a number of angles, made once."""
