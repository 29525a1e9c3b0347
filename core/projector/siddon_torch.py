"""Siddon's line integrals in torch, on the device of the volume: `siddon_numpy`, line by line, in tensors.

All planes are crossed at once and sorted, which suits a GPU and is slow on a CPU. Gradients are not recorded
here: the operator's autograd function calls `adjoint`, so that no graph of the segments is ever kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from .rays import Attenuation, IndexFan, IndexFans, IndexRays

# Crossings held at once, per kind of device: some ten arrays of this many float64 exist at the same time.
_CROSSINGS_CPU = 2**19
_CROSSINGS_GPU = 2**24


def forward(volume: Tensor, rays: IndexRays | IndexFan, attenuation: Attenuation | None = None) -> Tensor:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`, attenuated towards their sources."""
    voxels = volume.reshape(-1)
    integrals = [(voxels[index] * weight).sum(dim=1) for _, index, weight in _segments(volume, rays, attenuation)]
    return torch.cat(integrals) if integrals else volume.new_zeros(0)


def adjoint(volume: Tensor, values: Tensor, rays: IndexRays | IndexFan, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume, rays, attenuation):
        spread = weight * values[part, None]
        voxels.index_add_(0, index.reshape(-1), spread.reshape(-1).to(volume.dtype))


def derivatives(volume: Tensor, rays: IndexRays | IndexFan) -> Tensor:
    """What the ends of `rays` do to their integrals (N, 7), as `backends` describes it."""
    pieces = []
    voxels, shape = volume.reshape(-1), volume.shape
    line = _on_device(rays, volume.device)
    axes = torch.tensor([3, 0, 1, 2]).repeat_interleave(torch.tensor([2, *(n + 1 for n in shape)]))
    axes = axes.to(volume.device)  # of the crossings; 3: the ray's ends
    for part, alpha, middle, order in _cut([(shape, line)]):
        index, inside = _voxels(shape, line.part(part), middle)
        value = voxels[index].to(alpha.dtype).masked_fill_(~inside, 0.0)
        integral = (value * alpha.diff(dim=1)).sum(dim=1, keepdim=True)
        alpha, axis = alpha[:, 1:-1], axes[order[:, 1:-1]]
        jump = (value[:, :-1] - value[:, 1:]).masked_fill_((alpha <= 0) | (alpha >= 1), 0.0)
        jumps = [jump.masked_fill(axis != a, 0.0) for a in range(3)]
        direction = line.directions[part]
        over = torch.where(direction == 0, 1.0, direction)
        by_start = torch.stack([(j * (alpha - 1)).sum(dim=1) for j in jumps], dim=1) / over
        by_end = -torch.stack([(j * alpha).sum(dim=1) for j in jumps], dim=1) / over
        pieces.append(torch.cat([integral, by_start, by_end], dim=1))
    return torch.cat(pieces) if pieces else torch.zeros((0, 7), dtype=volume.dtype, device=volume.device)


def _segments(
    volume: Tensor, rays: IndexRays | IndexFan, attenuation: Attenuation | None
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), weight in mm (n, S).

    The weight is the segment's length, or, attenuated, the integral of exp(-integral of mu from the source) over it.
    A segment outside the volume has weight 0 and index 0.
    """
    device = volume.device
    line = _on_device(rays, device)
    lattices = [(volume.shape, line)]
    if attenuation is not None:
        mu_shape = attenuation.mu.shape
        mu_line = line if attenuation.rays is None else _on_device(attenuation.rays, device)
        if mu_line is not line:
            lattices.append((mu_shape, mu_line))
    for part, alpha, middle, _ in _cut(lattices):
        segment = alpha.diff(dim=1) * line.lengths[part, None]
        index, inside = _voxels(volume.shape, line.part(part), middle)
        weight = segment.masked_fill(~inside, 0.0)
        if attenuation is not None:
            mu_index, inside = _voxels(mu_shape, mu_line.part(part), middle)
            depth = attenuation.mu.reshape(-1)[mu_index].masked_fill_(~inside, 0.0) * segment
            weight *= torch.exp(depth - depth.cumsum(dim=1)) * _mean_transmission(depth)
        yield part, index, weight


@dataclass(frozen=True, eq=False)
class _Line:
    """`IndexRays` in tensors."""

    starts: Tensor
    directions: Tensor
    lengths: Tensor

    def part(self, which: slice) -> _Line:
        return _Line(self.starts[which], self.directions[which], self.lengths[which])


def _on_device(rays: IndexRays | IndexFan | IndexFans, device: torch.device) -> _Line:
    real = torch.float32 if device.type == "mps" else torch.float64  # Apple's GPUs have no float64
    rays = rays.listed()
    return _Line(*(torch.as_tensor(a, dtype=real).to(device) for a in (rays.starts, rays.directions, rays.lengths)))


def _cut(lattices: list[tuple[tuple[int, ...], _Line]]) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
    """The rays cut at the planes of all `lattices`, each a shape and the rays there, some rays at a time.

    Yields which rays (a slice), alpha of the cuts (n, S + 1) and of the segments' midpoints (n, S), and which crossing
    each cut is (n, S + 1), counted from 2 in the order of `_crossings`; 0 and 1 are the ray's ends.
    """
    lengths = lattices[0][1].lengths
    budget = _CROSSINGS_CPU if lengths.device.type == "cpu" else _CROSSINGS_GPU
    rays_at_once = max(1, budget // sum(sum(shape) + 5 for shape, _ in lattices))
    for first in range(0, len(lengths), rays_at_once):
        part = slice(first, first + rays_at_once)
        length = lengths[part, None]
        crossings = [torch.zeros_like(length), torch.ones_like(length)]
        for shape, line in lattices:
            crossings += _crossings(shape, line.part(part))
        alpha, order = torch.cat(crossings, dim=1).sort(dim=1)
        yield part, alpha, (alpha[:, 1:] + alpha[:, :-1]) / 2, order


def _crossings(shape: tuple[int, ...], line: _Line) -> Iterator[Tensor]:
    """Where the rays cross a lattice's planes, axis by axis: alpha (N, n + 1)."""
    for axis, n in enumerate(shape):
        s, d = line.starts[:, axis, None], line.directions[:, axis, None]
        parallel = d == 0
        planes = torch.arange(n + 1, dtype=s.dtype, device=s.device)
        # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
        alpha = ((planes - s) / torch.where(parallel, 1.0, d)).clamp_(0.0, 1.0)
        yield alpha.masked_fill_(parallel, 0.0)


def _voxels(shape: tuple[int, ...], line: _Line, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Flat index of the voxel in which each of the points `alpha` (N, S) of the rays lies, and whether it lies in any.

    The index of a point in no voxel is 0.
    """
    index = torch.zeros(alpha.shape, dtype=torch.int64, device=alpha.device)
    inside = torch.ones(alpha.shape, dtype=torch.bool, device=alpha.device)
    for axis, n in enumerate(shape):
        voxel = torch.floor(line.starts[:, axis, None] + alpha * line.directions[:, axis, None])
        inside &= (voxel >= 0) & (voxel < n)
        index = index * n + voxel.clamp_(0, n - 1).to(torch.int64)
    return index.masked_fill_(~inside, 0), inside


def _mean_transmission(depth: Tensor) -> Tensor:
    """Mean of exp(-t) over t from 0 to `depth`: (1 - exp(-depth)) / depth, 1 at 0."""
    return torch.where(depth != 0, -torch.expm1(-depth) / torch.where(depth != 0, depth, 1.0), 1.0)
