"""Steps through the exact operators, each of which a small U-Net corrects."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ..setup import Sample, Setup
from .network import Network, UNet, middle, positive, spread, surplus


class Model(Network):
    """In each step a U-Net gets the volume, those by OSEM, and the EM algorithm's change of it: the likelihood's gradient
    by the sensitivity. What it gives is added.

    In training a step's inner values are made again when its gradient is asked for: memory is that of one step, and a
    volume of each.

    Parameters
    ----------
    steps : int
    channels : sequence of int
        Of each level of a step's U-Net.
    through : bool
        Whether gradients pass the operators, too, which costs a projection and an adjoint more; else the change is taken
        as it is.
    volumes : int
        By OSEM.
    """

    def __init__(
        self, steps: int = 3, channels: Sequence[int] = (16, 32, 48), through: bool = True, *, volumes: int = 3
    ):
        super().__init__()
        self.nets, self.through = nn.ModuleList(UNet(volumes + 3, 1, channels) for _ in range(steps)), through

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`."""
        x, estimates = middle(sample), []
        for net in self.nets:
            if self.training and torch.is_grad_enabled():
                x = checkpoint(self._step, net, x, setup, sample, use_reentrant=False)
            else:
                x = self._step(net, x, setup, sample)
            estimates.append(x)
        return estimates

    def _step(self, net: nn.Module, x: Tensor, setup: Setup, sample: Sample) -> Tensor:
        with torch.set_grad_enabled(self.through and torch.is_grad_enabled()):
            change = spread(setup, surplus(setup, sample, x))
        return positive(x + net(torch.cat([x, sample.osem, 5 * change, 5 * change * x], 1)))
