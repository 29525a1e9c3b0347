"""Views as channels into a decoder of volumes: a network without geometry, for comparison."""

from collections.abc import Sequence
from typing import Any

from monai.networks.nets import Generator, Regressor
from torch import Tensor

from ...errors import InputError
from ..setup import Sample, ScannerSetup
from .network import LEAKY, Network, nonnegative


class ViewsAsChannels(Network):
    """An encoder of all images as channels of one image, and a decoder to a volume, for fixed numbers of views and voxels.

    Parameters
    ----------
    channels : sequence of int
        Number of channels of the levels at which images are halved; the volume has the same in reverse order.
    latent : int
        Size of the latent vector between images and volume.
    views, pixels, voxels
        Fixed sizes M, (n_v, n_u) and (n_x, n_y, n_z).
    """

    def __init__(
        self,
        channels: Sequence[int] = (64, 64, 32),
        latent: int = 256,
        *,
        views: int = 20,
        pixels: Sequence[int] = (32, 32),
        voxels: Sequence[int] = (40, 40, 40),
    ):
        super().__init__()
        if not channels or min(channels) < 1:
            raise InputError(f"network.channels: expected one level or more, each of 1 or more, got {list(channels)}")
        self.sizes = views, tuple(pixels), tuple(voxels)
        strides = [2] * len(channels)
        start = [-(-n // 2 ** len(channels)) for n in voxels]  # rounded up; the excess is cut off
        options = {"num_res_units": 1, "act": LEAKY, "norm": None}
        self.encoder = Regressor((views, *pixels), (latent,), channels, strides, **options)
        self.decoder = Generator((latent,), (channels[-1], *start), (*channels[-2::-1], 1), strides, **options)

    @classmethod
    def fixed(cls, setup: ScannerSetup) -> dict[str, Any]:
        """Return the arguments that follow from the setup: numbers of views, pixels and voxels."""
        M, *pixels = setup.A.shape_out
        return {"views": M, "pixels": pixels, "voxels": setup.A.shape_in}

    def forward(self, setup: ScannerSetup, sample: Sample) -> list[Tensor]:
        """Return one estimate; raise `InputError` for another number of views, pixels or voxels. See `Network`."""
        M, *pixels = setup.A.shape_out
        sizes = M, tuple(pixels), setup.A.shape_in
        if sizes != self.sizes:
            expected, actual = ("{} views of {} pixels and {} voxels".format(*s) for s in (self.sizes, sizes))
            raise InputError(f"channels: the network is for {expected}, not for {actual}")
        images = sample.counts - sample.background
        x = self.decoder(self.encoder(images / images.mean((1, 2, 3), keepdim=True).clamp(min=1e-9)))
        n_x, n_y, n_z = setup.A.shape_in
        return [nonnegative(x[..., :n_x, :n_y, :n_z].to(images.dtype))]
