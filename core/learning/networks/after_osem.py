"""A U-Net that corrects volumes by OSEM."""

from collections.abc import Sequence

from torch import Tensor

from ..setup import Sample, Setup
from .network import Network, UNet, middle, positive


class Model(Network):
    """Adds to the middle one of the volumes by OSEM what a U-Net makes of all of them.

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
