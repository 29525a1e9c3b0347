"""Steps of the EM algorithm through the exact operators, each with a small U-Net."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ..setup import Sample, Setup
from .network import Network, UNet, middle, positive, spread, surplus


class Model(Network):
    """Begins as `after_osem`, whose weights it can take; each step adds a part of an EM update and its own U-Net's change.

    The update is the gradient of the log-likelihood by the exact operators, divided by the sensitivity. A U-Net gets it,
    the volume, and those by OSEM.

    Parameters
    ----------
    steps : int
    channels : sequence of int
        Of each level of the U-Nets.
    learn_step : bool
        Each step also adds a learned multiple of the EM update, at first 0.
    through : bool
        Gradients in training flow through the operators; if not, each step takes its expected counts as given.
    dual : bool
        Before they are spread over the volume, the counts' surpluses are corrected by a small network on the images, which
        gets those of the step before, too, as in learned primal-dual reconstruction.
    save_memory : bool
        U-Nets are computed twice in training and keep nothing meanwhile.
    volumes : int
        By OSEM.

    References
    ----------
    J. Adler, O. Öktem, "Learned primal-dual reconstruction", IEEE Transactions on Medical Imaging 37 (2018) 1322-1332.
    """

    def __init__(
        self,
        steps: int = 2,
        channels: Sequence[int] = (16, 32, 48),
        learn_step: bool = True,
        through: bool = False,
        dual: bool = False,
        save_memory: bool = True,
        *,
        volumes: int = 3,
    ):
        super().__init__()
        self.through, self.save_memory = through, save_memory
        self.net = UNet(volumes, 1, channels)
        self.nets = nn.ModuleList(UNet(volumes + 3, 1, channels) for _ in range(steps))
        self.step = nn.Parameter(torch.zeros(steps), requires_grad=learn_step)
        self.duals = nn.ModuleList(UNet(2, 1, (8, 16, 16), dimensions=2) for _ in range(steps if dual else 0))

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`."""
        x, shares = positive(middle(sample) + self._of(self.net, sample.osem)), torch.zeros_like(sample.counts)
        estimates = [x]
        for k, net in enumerate(self.nets):
            found = surplus(setup, sample, x if self.through else x.detach())
            shares = found + self._correction(k, found, shares) if self.duals else found
            change = spread(setup, shares)
            features = torch.cat([x, 5 * change, 5 * change * x, sample.osem], 1)  # changes are some 20 % of the volume
            x = positive(x + self.step[k] * change * x + self._of(net, features))
            estimates.append(x)
        return estimates

    def _of(self, net: nn.Module, features: Tensor) -> Tensor:
        return checkpoint(net, features, use_reentrant=False) if self.save_memory else net(features)

    def _correction(self, k: int, found: Tensor, before: Tensor) -> Tensor:
        """What step k adds to the surpluses (B, M, n_v, n_u), view by view."""
        images = torch.stack([found, before], 2).flatten(0, 1)
        return self.duals[k](images).view(found.shape)  # type: ignore[no-any-return]
