"""Siddon's line integrals in torch, on the device of the volume: `siddon_numpy`, line by line, in tensors.

All planes are crossed at once and sorted, which suits a GPU and is slow on a CPU. Gradients are not recorded
here: the operator's autograd function calls `adjoint`, so that no graph of the segments is ever kept.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from .rays import IndexRays

# Crossings held at once, per kind of device: some ten arrays of this many float64 exist at the same time.
_CROSSINGS_CPU = 2**19
_CROSSINGS_GPU = 2**24


def forward(volume: Tensor, rays: IndexRays) -> Tensor:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`."""
    integrals = torch.empty(len(rays), dtype=volume.dtype, device=volume.device)
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume, rays):
        integrals[part] = (voxels[index] * weight).sum(dim=1).to(volume.dtype)
    return integrals


def adjoint(volume: Tensor, values: Tensor, rays: IndexRays) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume, rays):
        spread = weight * values[part, None]
        voxels.index_add_(0, index.reshape(-1), spread.reshape(-1).to(volume.dtype))


def _segments(volume: Tensor, rays: IndexRays) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), length in mm (n, S).

    A segment outside the volume has length 0 and index 0.
    """
    device, shape = volume.device, volume.shape
    real = torch.float32 if device.type == "mps" else torch.float64  # Apple's GPUs have no float64

    def on_device(array: object) -> Tensor:
        return torch.as_tensor(array, dtype=real).to(device)

    starts, directions, lengths = on_device(rays.starts), on_device(rays.directions), on_device(rays.lengths)
    budget = _CROSSINGS_CPU if device.type == "cpu" else _CROSSINGS_GPU
    rays_at_once = max(1, budget // (sum(shape) + 5))
    for first in range(0, len(rays), rays_at_once):
        part = slice(first, first + rays_at_once)
        start, direction, length = starts[part], directions[part], lengths[part]
        ends = torch.zeros((len(start), 2), dtype=real, device=device)
        ends[:, 1] = 1.0
        crossings = [ends]
        for axis, n in enumerate(shape):
            s, d = start[:, axis, None], direction[:, axis, None]
            parallel = d == 0
            planes = torch.arange(n + 1, dtype=real, device=device)
            # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
            alpha = ((planes - s) / torch.where(parallel, 1.0, d)).clamp_(0.0, 1.0)
            crossings.append(alpha.masked_fill_(parallel, 0.0))
        alpha = torch.cat(crossings, dim=1).sort(dim=1).values
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2

        index = torch.zeros(middle.shape, dtype=torch.int64, device=device)
        inside = torch.ones(middle.shape, dtype=torch.bool, device=device)
        for axis, n in enumerate(shape):
            voxel = torch.floor(start[:, axis, None] + middle * direction[:, axis, None])
            inside &= (voxel >= 0) & (voxel < n)
            index = index * n + voxel.clamp_(0, n - 1).to(torch.int64)
        index.masked_fill_(~inside, 0)
        yield part, index, (alpha.diff(dim=1) * length[:, None]).masked_fill_(~inside, 0.0)
