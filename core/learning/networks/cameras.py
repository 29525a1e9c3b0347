"""Each camera's own opinion in its coordinates (u, v, k), and their mean, weighed by content."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..setup import Sample, Setup
from .network import Network, UNet, middle, positive, surplus


class Model(Network):
    """One U-Net for all cameras, in (u, v, k), then another in the world.

    It begins as `after_osem`, whose weights it can take. The first U-Net gets a camera's image and by how much its counts
    exceed those expected, spread along its rays, and the volumes so far in its perspective: what the others hold. It gives a
    change of the volume, how sure it is of it, and features. The second gets the volumes by OSEM and over cameras the mean,
    the mean weighed by confidence, and the variance between them: it weighs the cameras voxel by voxel.

    Parameters
    ----------
    cameras : int
        How many are drawn for each step of training, and how many are in memory at once when all are used.
    rounds : int
        Of exchange: in each the cameras get the volume of the one before. All use the same weights.
    camera_channels, channels : sequence of int
        Of each level of the two U-Nets.
    features : int
        Of each camera, given to the second U-Net as means weighed by confidence.
    volumes : int
        By OSEM.
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

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`."""
        x = positive(middle(sample) + self.net(sample.osem))
        estimates = [x]
        for _ in range(self.rounds):
            mean, variance, weighed = self._exchange(setup, sample, x)
            estimates.append(positive(x + weighed[:, :1]))
            x = positive(x + self.fuse(torch.cat([sample.osem, x, mean, variance, weighed], 1)))
            estimates.append(x)
        return estimates

    def _exchange(self, setup: Setup, sample: Sample, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Over cameras the mean and variance of their changes, and the weighed means of changes and features (B, …)."""
        images = torch.stack([self._activity(setup, sample), surplus(setup, sample, x)], 2)  # (B, M, 2, n_v, n_u)
        volumes = torch.cat([sample.osem, x], 1)
        M = images.shape[1]
        used = torch.randperm(M)[: self.cameras] if self.training else torch.arange(M)
        seen = total = squares = weights = weighed = torch.zeros((), dtype=x.dtype, device=x.device)
        for some in used.split(self.cameras):  # sums, so that no volume of every camera is held
            opinions, inside = self._opinions(setup, images[:, some], volumes, some)
            change, weight = opinions[:, :, :1], inside * opinions[:, :, 1:2].clamp(-6, 6).exp()
            seen = seen + inside.sum(1)
            total = total + (inside * change).sum(1)
            squares = squares + (inside * change**2).sum(1)
            weights = weights + weight.sum(1)
            weighed = weighed + (weight * torch.cat([change, opinions[:, :, 2:]], 2)).sum(1)
        mean = total / seen.clamp(min=1)
        return mean, squares / seen.clamp(min=1) - mean**2, weighed / (weights + 1e-3)

    def _activity(self, setup: Setup, sample: Sample) -> Tensor:
        """Mean activity along the rays of each pixel (B, M, n_v, n_u), in units of the scale, if it is even."""
        uniform = setup.uniform.to(sample.counts)
        scale = sample.scale.view(-1, 1, 1, 1)
        return (sample.counts - sample.background) / (uniform + 0.05 * uniform.max()) / scale

    def _opinions(self, setup: Setup, images: Tensor, volumes: Tensor, some: Tensor) -> tuple[Tensor, Tensor]:
        """What V cameras make of their images (B, V, 2, n_v, n_u), in the world (B, V, outputs, …); inside (1, V, 1, …)."""
        seen = setup.maps.to_views(volumes, some)  # (B, V, volumes, n_u, n_v, n_k)
        n_k = seen.shape[-1]
        spread = images.transpose(-1, -2)[..., None].expand(*seen.shape[:2], 2, *seen.shape[3:])
        depth = torch.linspace(-1, 1, n_k, dtype=seen.dtype, device=seen.device).expand_as(seen[:, :, :1])
        opinions = self.camera(torch.cat([spread, seen, depth], 2).flatten(0, 1)).unflatten(0, seen.shape[:2])
        return setup.maps.to_volume(opinions, some)
