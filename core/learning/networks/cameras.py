"""A network with one estimate per camera, in its coordinates (u, v, k), averaged with learned weights."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..setup import Sample, ScannerSetup
from .network import Network, UNet, middle_osem, nonnegative, relative_residual


class CameraNets(Network):
    """Network with one U-Net for all cameras, in (u, v, k), and another for the volume.

    It starts as `after_osem`, whose weights it can load. The first U-Net gets a camera's image and the relative residual of
    its counts, both spread along its rays, and the present volumes in its perspective, which contain the information of the
    other cameras. Its outputs are a change of the volume, the logarithm of the camera's confidence in it, and features. The
    second U-Net gets the OSEM volumes, and over the cameras the mean of the changes, their mean weighted by confidence, and
    their variance: it weighs the cameras voxel by voxel.

    Parameters
    ----------
    cameras : int
        Number of cameras drawn for each step of training, and number in memory at once when all are used.
    rounds : int
        Number of exchanges: in each, the cameras get the volume of the one before. All use the same weights.
    camera_channels, channels : sequence of int
        Number of channels of each level of the two U-Nets.
    features : int
        Number of features of each camera; the second U-Net gets their means weighted by confidence.
    volumes : int
        Number of OSEM volumes.
    """

    may_be_0 = ("features",)

    def __init__(
        self,
        cameras: int = 5,
        rounds: int = 1,
        camera_channels: Sequence[int] = (16, 32, 32),
        channels: Sequence[int] = (16, 32, 48),
        features: int = 3,
        *,
        volumes: int = 3,
    ):
        super().__init__()
        self.cameras, self.rounds = cameras, rounds
        self.net = UNet(volumes, 1, channels)
        self.camera = UNet(volumes + 4, 2 + features, camera_channels, name="camera_channels")
        self.fuse = UNet(volumes + 4 + features, 1, channels)

    def forward(self, setup: ScannerSetup, sample: Sample) -> list[Tensor]:
        """Return the estimates of the volumes, the result last; see `Network`."""
        x = nonnegative(middle_osem(sample) + self.net(sample.osem))
        estimates = [x]
        for _ in range(self.rounds):
            mean, variance, weighted = self._exchange(setup, sample, x)
            estimates.append(nonnegative(x + weighted[:, :1]))
            x = nonnegative(x + self.fuse(torch.cat([sample.osem, x, mean, variance, weighted], 1)))
            estimates.append(x)
        return estimates

    def _exchange(self, setup: ScannerSetup, sample: Sample, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return, over the cameras, mean and variance of the changes, and weighted means of changes and features (B, …)."""
        images = torch.stack([self._activity(setup, sample), relative_residual(setup, sample, x)], 2)
        volumes = torch.cat([sample.osem, x], 1)
        n_cameras = images.shape[1]
        cameras = torch.randperm(n_cameras)[: self.cameras] if self.training else torch.arange(n_cameras)
        n = total = squares = weight_sum = weighted = torch.zeros((), dtype=x.dtype, device=x.device)
        # Sums over the n cameras that see a voxel, so that only the volumes of one batch of cameras are in memory.
        for batch in cameras.split(self.cameras):
            outputs, inside = self._outputs(setup, images[:, batch], volumes, batch)
            change, weight = outputs[:, :, :1], inside * outputs[:, :, 1:2].clamp(-6, 6).exp()
            n = n + inside.sum(1)
            total = total + (inside * change).sum(1)
            squares = squares + (inside * change**2).sum(1)
            weight_sum = weight_sum + weight.sum(1)
            weighted = weighted + (weight * torch.cat([change, outputs[:, :, 2:]], 2)).sum(1)
        mean = total / n.clamp(min=1)
        return mean, squares / n.clamp(min=1) - mean**2, weighted / (weight_sum + 1e-3)

    def _activity(self, setup: ScannerSetup, sample: Sample) -> Tensor:
        """Return the mean activity (B, M, n_v, n_u) along each pixel's ray if it is uniform, in units of the scale."""
        uniform = setup.uniform.to(sample.counts)
        scale = sample.scale.view(-1, 1, 1, 1)
        return (sample.counts - sample.background) / (uniform + 0.05 * uniform.max()) / scale

    def _outputs(self, setup: ScannerSetup, images: Tensor, volumes: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
        """Return the camera network's outputs (B, V, F, n_x, n_y, n_z) for V cameras, and which voxels each camera sees.

        `images` (B, V, 2, n_v, n_u) are the cameras' own, `volumes` (B, C, n_x, n_y, n_z) the same for all. The visibility
        (1, V, 1, n_x, n_y, n_z) is 1 where a camera sees a voxel, else 0.
        """
        view_volumes = setup.maps.to_views(volumes, cameras)  # (B, V, volumes, n_u, n_v, n_k)
        n_k = view_volumes.shape[-1]
        view_images = images.transpose(-1, -2)[..., None].expand(*view_volumes.shape[:2], 2, *view_volumes.shape[3:])
        depths = torch.linspace(-1, 1, n_k, dtype=view_volumes.dtype, device=view_volumes.device)
        depth = depths.expand_as(view_volumes[:, :, :1])
        outputs = self.camera(torch.cat([view_images, view_volumes, depth], 2).flatten(0, 1))
        return setup.maps.to_volume(outputs.unflatten(0, view_volumes.shape[:2]), cameras)
