"""What all networks share: the interface, the U-Net, what counts say of a volume, and how values stay at least 0."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import Any

import torch
from monai.networks.nets import DynUNet
from torch import Tensor, nn
from torch.nn import functional

from ...errors import InputError
from ..setup import Sample, Setup

LEAKY = ("leakyrelu", {"negative_slope": 0.1, "inplace": True})
"""The rectifier of all networks, as MONAI names it."""
_LEVELS = 3  # fewer are no U-Net for MONAI


class Network(nn.Module, ABC):
    """A way from counts to a volume. Its arguments have plain values and defaults, which recipes set.

    Arguments that only have names (after ``*``) are no settings: `fixed` has their values for a setup. It keeps nothing
    else of a scanner: `setup` is given with each call, so that a network that is told the geometry works with any. What
    needs a fixed number of views or voxels (`channels`) says so with `InputError`.
    """

    may_be_0: Collection[str] = ()
    """Arguments that may be 0; other whole numbers are 1 or more."""

    @classmethod
    def fixed(cls, setup: Setup) -> dict[str, Any]:
        """Arguments that follow from the setup: ``Model(**settings, **Model.fixed(setup))``."""
        return {"volumes": len(setup.after)}

    @abstractmethod
    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """Volumes (B, 1, n_x, n_y, n_z) in units of the samples' scale: estimates on the way, and last the result."""


class UNet(nn.Module):
    """MONAI's U-Net in 3-D or 2-D, for any size, without normalisation, which would lose the activity.

    Its last layer begins with 0: a network that corrects a volume begins with that volume. `InputError` for fewer than
    three levels of `channels`, which it calls `name`, or a level without a channel.
    """

    def __init__(self, inputs: int, outputs: int, channels: Sequence[int], dimensions: int = 3, name: str = "channels"):
        super().__init__()
        if len(channels) < _LEVELS or min(channels) < 1:
            raise InputError(f"network.{name}: expected three levels or more, each of 1 or more, got {list(channels)}")
        strides = (1, *[2] * (len(channels) - 1))
        self.divisor = 2 ** (len(channels) - 1)
        kernels, like = [3] * len(channels), {"norm_name": "", "act_name": LEAKY}
        self.net = DynUNet(dimensions, inputs, outputs, kernels, strides, strides[1:], filters=list(channels), **like)
        last = self.net.output_block.conv.conv
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, …) to (B, outputs, …), of the same type also where it computes with another."""
        sides = x.shape[2:]
        missing = [-n % self.divisor for n in sides]
        padded = functional.pad(x, [each for n in reversed(missing) for each in (0, n)])
        layout = torch.channels_last_3d if len(sides) == 3 else torch.channels_last
        y: Tensor = self.net(padded.contiguous(memory_format=layout)).to(x.dtype)
        return y[(..., *(slice(n) for n in sides))]


def middle(sample: Sample) -> Tensor:
    """The volume by OSEM (B, 1, n_x, n_y, n_z) that networks begin with, of which `Sample.scale` is told."""
    m = sample.osem.shape[1] // 2
    return sample.osem[:, m : m + 1]


def surplus(setup: Setup, sample: Sample, x: Tensor) -> Tensor:
    """By how much the counts exceed those that volumes x (B, 1, …) let expect, as a share: (B, M, n_v, n_u)."""
    activity = functional.relu(x[:, 0]) * sample.scale.view(-1, 1, 1, 1)  # leaky in training: counts cannot be negative
    expected = setup.A(activity) + sample.background
    return (sample.counts + 0.5) / (expected + 0.5) - 1


def spread(setup: Setup, shares: Tensor) -> Tensor:
    """The mean (B, 1, n_x, n_y, n_z) of the shares (B, M, n_v, n_u) of the pixels that see a voxel, as they see it.

    Of `surplus` it is the EM algorithm's relative change of the volume.
    """
    sensitivity = setup.sensitivity.to(shares)
    return (setup.A.T(shares) / sensitivity.clamp(min=1e-3 * float(sensitivity.max())))[:, None]


def positive(x: Tensor) -> Tensor:
    """At least 0 when it is used; leaky in training, where a ReLU at the end can die for good."""
    return functional.leaky_relu(x, 0.1) if torch.is_grad_enabled() else functional.relu(x)
