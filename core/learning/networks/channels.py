"""Views as channels into a decoder of volumes, which is told no geometry: what the others are compared with."""

from collections.abc import Sequence
from typing import Any

from monai.networks.nets import Generator, Regressor
from torch import Tensor

from ...errors import InputError
from ..setup import Sample, Setup
from .network import LEAKY, Network, positive


class Model(Network):
    """All images as channels of one, made ever smaller; then a volume made ever larger. For one number of views and voxels.

    Parameters
    ----------
    channels : sequence of int
        Of the images as they get smaller by 2; those of the volume are the same backwards.
    latent : int
        Numbers between images and volume.
    views, pixels, voxels
        M, (n_v, n_u) and (n_x, n_y, n_z) that it is for.
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
        start = [-(-n // 2 ** len(channels)) for n in voxels]  # rounded up: what is too much is cut off
        like = {"num_res_units": 1, "act": LEAKY, "norm": None}
        self.encoder = Regressor((views, *pixels), (latent,), channels, strides, **like)
        self.decoder = Generator((latent,), (channels[-1], *start), (*channels[-2::-1], 1), strides, **like)

    @classmethod
    def fixed(cls, setup: Setup) -> dict[str, Any]:
        """See `Network`."""
        M, *pixels = setup.A.shape_out
        return {"views": M, "pixels": pixels, "voxels": setup.A.shape_in}

    def forward(self, setup: Setup, sample: Sample) -> list[Tensor]:
        """See `Network`; raises `InputError` for another number of views, pixels or voxels."""
        M, *pixels = setup.A.shape_out
        sizes = M, tuple(pixels), setup.A.shape_in
        if sizes != self.sizes:
            own, given = ("{} views of {} pixels and {} voxels".format(*each) for each in (self.sizes, sizes))
            raise InputError(f"channels: the network is for {own}, not for {given}")
        images = sample.counts - sample.background
        x = self.decoder(self.encoder(images / images.mean((1, 2, 3), keepdim=True).clamp(min=1e-9)))
        n_x, n_y, n_z = setup.A.shape_in
        return [positive(x[..., :n_x, :n_y, :n_z].to(images.dtype))]
