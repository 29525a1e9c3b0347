"""Unrolled EM: steps with the exact operators, each with a small U-Net."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ..setup import Sample, ScannerSetup
from .network import Network, UNet, middle_osem, nonnegative, normalized_backprojection, relative_residual


class UnrolledEm(Network):
    """EM steps with U-Nets: each step adds a multiple of the EM update and the output of the step's own U-Net.

    It starts as `after_osem`, whose weights it can load. The EM update is the gradient of the log-likelihood by the exact
    operators, divided by the sensitivity and times the volume. A U-Net gets it, the volume and the OSEM volumes.

    Parameters
    ----------
    steps : int
        Number of steps.
    channels : sequence of int
        Number of channels of each level of the U-Nets.
    learn_step : bool
        Whether the multiple of the EM update, at first 0, is learned.
    through : bool
        Whether training gradients flow through the operators; if not, each step's expected counts are constants.
    dual : bool
        Whether relative residuals are corrected by a small network on the images before their backprojection, as in learned
        primal-dual reconstruction; it also gets those of the step before.
    save_memory : bool
        Whether U-Nets are computed twice in training instead of keeping intermediate results.
    volumes : int
        Number of OSEM volumes.

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

    def forward(self, setup: ScannerSetup, sample: Sample) -> list[Tensor]:
        """Return the estimates of the volumes, the result last; see `Network`."""
        x = nonnegative(middle_osem(sample) + self._run(self.net, sample.osem))
        corrected, estimates = torch.zeros_like(sample.counts), [x]
        for k, net in enumerate(self.nets):
            residual = relative_residual(setup, sample, x if self.through else x.detach())
            corrected = residual + self._correction(k, residual, corrected) if self.duals else residual
            change = normalized_backprojection(setup, corrected)
            features = torch.cat([x, 5 * change, 5 * change * x, sample.osem], 1)  # 5, as changes are about 20 %
            x = nonnegative(x + self.step[k] * change * x + self._run(net, features))
            estimates.append(x)
        return estimates

    def _run(self, net: nn.Module, features: Tensor) -> Tensor:
        """Return the network's output, recomputed in the backward pass if memory is to be saved."""
        return checkpoint(net, features, use_reentrant=False) if self.save_memory else net(features)

    def _correction(self, k: int, residual: Tensor, previous: Tensor) -> Tensor:
        """Return step k's correction (B, M, n_v, n_u) of the relative residual, view by view.

        `previous` is the corrected residual of the step before.
        """
        images = torch.stack([residual, previous], 2).flatten(0, 1)
        return self.duals[k](images).view(residual.shape)  # type: ignore[no-any-return]
