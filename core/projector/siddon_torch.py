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
    voxels = volume.reshape(-1)
    integrals = [(voxels[index] * weight).sum(dim=1) for _, index, weight in _segments(volume, rays)]
    return torch.cat(integrals) if integrals else volume.new_zeros(0)


def adjoint(volume: Tensor, values: Tensor, rays: IndexRays) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume, rays):
        spread = weight * values[part, None]
        voxels.index_add_(0, index.reshape(-1), spread.reshape(-1).to(volume.dtype))


def derivatives(volume: Tensor, rays: IndexRays) -> Tensor:
    """What the ends of `rays` do to their integrals (N, 7), as `backends` describes it."""
    pieces = []
    voxels = volume.reshape(-1)
    for _, direction, _, index, inside, alpha, axis in _cut(volume, rays):
        value = voxels[index].to(alpha.dtype).masked_fill_(~inside, 0.0)
        integral = (value * alpha.diff(dim=1)).sum(dim=1, keepdim=True)
        alpha, axis = alpha[:, 1:-1], axis[:, 1:-1]
        jump = (value[:, :-1] - value[:, 1:]).masked_fill_((alpha <= 0) | (alpha >= 1), 0.0)
        jumps = [jump.masked_fill(axis != a, 0.0) for a in range(3)]
        over = torch.where(direction == 0, 1.0, direction)
        by_start = torch.stack([(j * (alpha - 1)).sum(dim=1) for j in jumps], dim=1) / over
        by_end = -torch.stack([(j * alpha).sum(dim=1) for j in jumps], dim=1) / over
        pieces.append(torch.cat([integral, by_start, by_end], dim=1))
    return torch.cat(pieces) if pieces else torch.zeros((0, 7), dtype=volume.dtype, device=volume.device)


def _segments(volume: Tensor, rays: IndexRays) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), length in mm (n, S).

    A segment outside the volume has length 0 and index 0.
    """
    for part, _, length, index, inside, alpha, _ in _cut(volume, rays):
        yield part, index, (alpha.diff(dim=1) * length[:, None]).masked_fill_(~inside, 0.0)


def _cut(volume: Tensor, rays: IndexRays) -> Iterator[tuple[slice, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """The rays cut at their crossings, some rays at a time.

    Yields which rays (a slice), their directions (n, 3) and lengths (n,); of each segment the flat voxel index (n, S),
    0 outside, and whether it is inside (n, S); of each cut its alpha (n, S + 1) and the axis of the plane (n, S + 1),
    3 at the ray's ends.
    """
    device, shape = volume.device, volume.shape
    real = torch.float32 if device.type == "mps" else torch.float64  # Apple's GPUs have no float64

    def on_device(array: object) -> Tensor:
        return torch.as_tensor(array, dtype=real).to(device)

    starts, directions, lengths = on_device(rays.starts), on_device(rays.directions), on_device(rays.lengths)
    planes_of = torch.tensor([2, *(n + 1 for n in shape)])
    axes = torch.tensor([3, 0, 1, 2]).repeat_interleave(planes_of).to(device)
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
        alpha, order = torch.cat(crossings, dim=1).sort(dim=1)
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2

        index = torch.zeros(middle.shape, dtype=torch.int64, device=device)
        inside = torch.ones(middle.shape, dtype=torch.bool, device=device)
        for axis, n in enumerate(shape):
            voxel = torch.floor(start[:, axis, None] + middle * direction[:, axis, None])
            inside &= (voxel >= 0) & (voxel < n)
            index = index * n + voxel.clamp_(0, n - 1).to(torch.int64)
        index.masked_fill_(~inside, 0)
        yield part, direction, length, index, inside, alpha, axes[order]
