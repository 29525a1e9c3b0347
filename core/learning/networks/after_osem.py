"""A U-Net that corrects volumes by OSEM: all that it knows of the geometry, it has from them."""

from collections.abc import Sequence

from torch import Tensor

from ..setup import Sample, Setup
from .network import Network, UNet, middle, positive


class Model(Network):
    """A U-Net with the volumes by OSEM as channels, whose result is added to the middle one.

    Parameters
    ----------
    channels : sequence of int
        Of each level of the U-Net.
    volumes : int
        By OSEM.
    """

    def __init__(self, channels: Sequence[int] = (16, 32, 48), *, volumes: int = 3):
        super().__init__()
        self.net = UNet(volumes, 1, channels)

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`."""
        return [positive(middle(sample) + self.net(sample.osem))]
