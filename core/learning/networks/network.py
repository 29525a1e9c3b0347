"""What all networks share: the interface, the U-Net, and how values stay at least 0."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from monai.networks.nets import DynUNet
from torch import Tensor, nn

from ..setup import Sample, Setup


class Network(nn.Module, ABC):
    """A way from counts to a volume. Its arguments have plain values and defaults, which recipes set.

    It keeps nothing of a scanner: `setup` is given with each call, so that a network that is told the geometry works with
    any. What needs a fixed number of views or voxels (`channels`) says so with `InputError`.
    """

    @abstractmethod
    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """Volumes (B, 1, n_x, n_y, n_z) in units of the samples' scale: estimates on the way, all trained; the last is the result."""


def unet(inputs: int, outputs: int, channels: Sequence[int]) -> nn.Module:
    """MONAI's U-Net in 3-D without normalisation, which would lose the activity; each side a multiple of 2 ** levels.

    Its last layer begins with 0: a network that corrects a volume begins with that volume.
    """
    strides, activation = (1, *[2] * (len(channels) - 1)), ("leakyrelu", {"negative_slope": 0.1, "inplace": True})
    net = DynUNet(
        3,
        inputs,
        outputs,
        [3] * len(channels),
        strides,
        strides[1:],
        filters=list(channels),
        norm_name="",
        act_name=activation,
    )
    last = net.output_block.conv.conv
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return net


def positive(x: Tensor) -> Tensor:
    """At least 0 when it is used; leaky in training, where a ReLU at the end can die for good."""
    return nn.functional.leaky_relu(x, 0.1) if torch.is_grad_enabled() else nn.functional.relu(x)
