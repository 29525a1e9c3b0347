"""A network that infers parallel projections from pinhole images, followed by filtered backprojection."""

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
from ..setup import Sample, ScannerSetup
from .network import Network, UNet, middle_osem, nonnegative, normalized_backprojection, relative_residual


class ParallelProjections(Network):
    """A 2-D U-Net that corrects parallel projections of the OSEM volume, followed by FBP.

    For each projection the U-Net gets this projection and its neighbours in angle, of the OSEM volumes and of the relative
    EM update, which contains what the counts say beyond these volumes.

    Parameters
    ----------
    angles : int
        Number of projections, over half a circle around z.
    neighbours : int
        Number of neighbours on either side of a projection.
    channels : sequence of int
        Number of channels of each level of the U-Net.
    volumes : int
        Number of OSEM volumes.
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

    def forward(self, setup: ScannerSetup, sample: Sample) -> list[Tensor]:
        """Return the estimates of the volumes, the result last; see `Network`."""
        beam, x = parallel_beam(setup.A.grid, self.angles), middle_osem(sample)
        update = x * normalized_backprojection(setup, relative_residual(setup, sample, x))
        volumes = torch.cat([sample.osem, 5 * update], 1)
        images = beam.project(volumes) / beam.length  # (B, volumes + 1, angles, n_v, n_u)
        correction = self.net(self._stacks(images).flatten(0, 1)).view(len(x), self.angles, *images.shape[-2:])
        return [nonnegative(beam.fbp(images[:, sample.osem.shape[1] // 2] + correction)[:, None] * beam.length)]

    def _stacks(self, images: Tensor) -> Tensor:
        """Return each projection with its neighbours as channels, (B, angles, channels, n_v, n_u).

        The neighbours of the first and last angles are those half a circle on, mirrored in u.
        """
        n = self.neighbours
        extended = torch.cat([images[:, :, -n:].flip(-1), images, images[:, :, :n].flip(-1)], 2) if n else images
        return extended.unfold(2, 2 * n + 1, 1).permute(0, 2, 1, 5, 3, 4).flatten(2, 3)


class ParallelBeam:
    """Projections along parallel rays at `angles` over half a circle around z, and FBP, both differentiable.

    Attributes
    ----------
    project : Projector
        From volumes (…, n_x, n_y, n_z) to line integrals (…, angles, n_v, n_u), value x mm.
    length : float
        Width of the grid, mm: line integrals divided by it have about the size of the volume's values.
    """

    def __init__(self, grid: Grid, angles: int):
        corners = grid.corners()
        center, voxel = corners.mean(0), float(min(grid.spacing))
        self.pitch = voxel / 2, voxel  # of u, v; half a voxel along u, or the adjoint would be uneven
        size = corners - center
        width, height = 2 * np.linalg.norm(size[:, :2], axis=1).max(), 2 * np.abs(size[:, 2]).max()
        shape = int(np.ceil(height / voxel - 1e-6)), int(np.ceil(2 * width / voxel))
        views = parallel_views(np.arange(angles) * np.pi / angles, shape, self.pitch, center=center)
        self.project, self.length = Projector(grid, views), float(width)
        # Each view's adjoint sums to voxel volume by pixel area; FBP needs the angle step by the pitch of u.
        weight = np.pi / angles / self.pitch[0] * np.prod(self.pitch) / grid.voxel_volume
        self._filter = torch.as_tensor(ramp_matrix(shape[1], "ramp") * weight)

    def fbp(self, images: Tensor) -> Tensor:
        """Return volumes (B, n_x, n_y, n_z) by FBP of line integrals (B, angles, n_v, n_u), by the projector's adjoint."""
        return self.project.T(images @ self._filter.to(images))


parallel_beam = lru_cache(maxsize=4)(ParallelBeam)
"""Cached constructor of the `ParallelBeam` of a grid and a number of angles."""
