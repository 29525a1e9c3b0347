"""A U-Net that corrects volumes by OSEM."""

from collections.abc import Sequence

from torch import Tensor

from ..setup import Sample, ScannerSetup
from .network import Network, UNet, middle_osem, nonnegative


class AfterOsem(Network):
    """Adds to the middle OSEM volume the output of a U-Net that gets all OSEM volumes.

    Parameters
    ----------
    channels : sequence of int
        Number of channels of each level of the U-Net.
    volumes : int
        Number of OSEM volumes.
    """

    def __init__(self, channels: Sequence[int] = (16, 32, 48), *, volumes: int = 3):
        super().__init__()
        self.net = UNet(volumes, 1, channels)

    def forward(self, setup: ScannerSetup, sample: Sample) -> list[Tensor]:
        """Return the estimates of the volumes, the result last; see `Network`."""
        return [nonnegative(middle_osem(sample) + self.net(sample.osem))]
