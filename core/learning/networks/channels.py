"""Views as channels of an image, and then a volume: a network that is told no geometry, and has to learn it."""

import math
from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from ...errors import InputError
from ..setup import Sample, Setup
from .network import Network


class Model(Network):
    """An encoder of all images together and a decoder into the volume. It is of one number of views, pixels and voxels.

    Parameters
    ----------
    width : int
        Channels of its layers.
    code : int
        Numbers between encoder and decoder.
    images, voxels : sequence of int
        The shapes that it is for.
    """

    def __init__(self, width: int = 64, code: int = 256, *, images: Sequence[int], voxels: Sequence[int]):
        super().__init__()
        self.images, self.voxels = tuple(images), tuple(voxels)
        if any(n % 8 for n in (*self.images[1:], *self.voxels)):
            raise InputError(f"network.kind: channels needs pixels and voxels in multiples of 8, got {self.shapes}")
        self.coarse = [16, *(n // 8 for n in voxels)]
        layers: list[nn.Module] = []
        for n_in, n_out in ((self.images[0], width), (width, width), (width, 16)):
            layers += [nn.Conv2d(n_in, n_out, 3, 2, 1), nn.LeakyReLU(0.1)]
        between = [nn.Linear(math.prod(self.images[1:]) // 4, code), nn.LeakyReLU(0.1)]
        self.encode = nn.Sequential(*layers, nn.Flatten(), *between, nn.Linear(code, math.prod(self.coarse)))
        layers = []
        for n_in, n_out in ((16, width), (width, width // 2), (width // 2, 16)):
            layers += [nn.ConvTranspose3d(n_in, n_out, 2, 2), nn.LeakyReLU(0.1)]
            layers += [nn.Conv3d(n_out, n_out, 3, padding=1), nn.LeakyReLU(0.1)]
        self.decode = nn.Sequential(*layers, nn.Conv3d(16, 1, 3, padding=1), nn.Softplus())

    @classmethod
    def fixed(cls, setup: Setup) -> dict[str, Any]:
        """See `Network`."""
        return {"images": setup.A.shape_out, "voxels": setup.A.shape_in}

    @property
    def shapes(self) -> str:
        """What it is for, in words."""
        return f"{' x '.join(map(str, self.images))} pixels, {' x '.join(map(str, self.voxels))} voxels"

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`."""
        if (setup.A.shape_out, setup.A.shape_in) != (self.images, self.voxels):
            raise InputError(f"network of views as channels: it is for {self.shapes} alone")
        total = sample.counts.sum((1, 2, 3)).clamp(min=1)
        code = self.encode(sample.counts * (math.prod(self.images) / total.view(-1, 1, 1, 1)))
        even = total / setup.sensitivity.sum() / sample.scale  # the activity, if it were the same everywhere
        return [self.decode(code.view(-1, *self.coarse)) * even.view(-1, 1, 1, 1, 1)]
