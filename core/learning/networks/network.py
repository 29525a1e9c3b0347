"""Parts that all networks share: the interface, the U-Net, data-consistency terms, non-negativity."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import Any

import torch
from monai.networks.nets import DynUNet
from torch import Tensor, nn
from torch.nn import functional

from ...errors import InputError
from ..setup import Sample, ScannerSetup

LEAKY = ("leakyrelu", {"negative_slope": 0.1, "inplace": True})
"""Activation function of all networks, in MONAI's notation."""
_LEVELS = 3  # least number of levels of MONAI's U-Net


class Network(nn.Module, ABC):
    """Interface of networks that compute volumes from counts.

    The constructor's arguments have plain values and defaults; recipes set them. Keyword-only arguments (after ``*``) are no
    settings: `fixed` derives them from a setup. A network stores nothing else about a scanner: it gets the `setup` with each
    call, so that a network that uses the geometry works with any scanner. One that needs a fixed number of views or voxels
    (`channels`) refuses others with `InputError`.
    """

    may_be_0: Collection[str] = ()
    """Names of arguments that may be 0; other integers are 1 or more."""

    @classmethod
    def fixed(cls, setup: ScannerSetup) -> dict[str, Any]:
        """Return the keyword-only arguments that follow from a setup, for ``cls(**settings, **cls.fixed(setup))``."""
        return {"volumes": len(setup.after)}

    @abstractmethod
    def forward(self, setup: ScannerSetup, sample: Sample) -> list[Tensor]:
        """Return volumes (B, 1, n_x, n_y, n_z) in units of the samples' scale: intermediate estimates, the result last."""


class UNet(nn.Module):
    """MONAI's U-Net in 3-D or 2-D, for any size, without normalisation, which would lose the activity.

    The weights of its last layer are 0 at first, so that a network that corrects a volume starts with that volume. Raises
    `InputError` for fewer than three levels of `channels`, which messages call `name`, or a level without channels.
    """

    def __init__(self, inputs: int, outputs: int, channels: Sequence[int], dimensions: int = 3, name: str = "channels"):
        super().__init__()
        if len(channels) < _LEVELS or min(channels) < 1:
            raise InputError(f"network.{name}: expected three levels or more, each of 1 or more, got {list(channels)}")
        strides = (1, *[2] * (len(channels) - 1))
        self.divisor = 2 ** (len(channels) - 1)
        kernels, layers = [3] * len(channels), {"norm_name": "", "act_name": LEAKY}
        self.net = DynUNet(dimensions, inputs, outputs, kernels, strides, strides[1:], filters=list(channels), **layers)
        last = self.net.output_block.conv.conv
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return outputs (B, outputs, …) for inputs (B, inputs, …), in the inputs' type even with mixed precision."""
        sides = x.shape[2:]
        padding = [-n % self.divisor for n in sides]
        padded = functional.pad(x, [width for n in reversed(padding) for width in (0, n)])
        layout = torch.channels_last_3d if len(sides) == 3 else torch.channels_last
        y: Tensor = self.net(padded.contiguous(memory_format=layout)).to(x.dtype)
        return y[(..., *(slice(n) for n in sides))]


def middle_osem(sample: Sample) -> Tensor:
    """Return the OSEM volume of the middle iteration, (B, 1, n_x, n_y, n_z), whose root mean square is `Sample.scale`."""
    m = sample.osem.shape[1] // 2
    return sample.osem[:, m : m + 1]


def relative_residual(setup: ScannerSetup, sample: Sample, x: Tensor) -> Tensor:
    """Return ``(counts + 0.5) / (A x + background + 0.5) - 1``, (B, M, n_v, n_u), for volumes x (B, 1, n_x, n_y, n_z)."""
    # In training x may be below 0, but expected counts may not.
    activity = functional.relu(x[:, 0]) * sample.scale.view(-1, 1, 1, 1)
    expected = setup.A(activity) + sample.background
    return (sample.counts + 0.5) / (expected + 0.5) - 1


def normalized_backprojection(setup: ScannerSetup, images: Tensor) -> Tensor:
    """Return the backprojection ``A^T r / A^T 1`` of images r (B, M, n_v, n_u): (B, 1, n_x, n_y, n_z).

    For r of `relative_residual` it is the relative change of the volume by the EM algorithm.
    """
    sensitivity = setup.sensitivity.to(images)
    return (setup.A.T(images) / sensitivity.clamp(min=1e-3 * float(sensitivity.max())))[:, None]


def nonnegative(x: Tensor) -> Tensor:
    """Return x limited to values >= 0; in training with a slope of 0.1 below 0, since a ReLU can get stuck at 0."""
    return functional.leaky_relu(x, 0.1) if torch.is_grad_enabled() else functional.relu(x)
