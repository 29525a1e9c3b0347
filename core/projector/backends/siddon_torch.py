"""Siddon's line integrals in torch, on the device of the volume: `siddon_numpy`, line by line, in tensors.

All planes are crossed at once and sorted, which suits a GPU and is slow on a CPU. Gradients are not recorded
here: the autograd functions call `adjoint`, `mu_gradient` and `derivatives`, so that no graph of the segments is ever
kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..rays import Attenuation, Rays

# Crossings held at once, per kind of device: some ten arrays of this many float64 exist at the same time.
_CROSSINGS_CPU = 2**17
_CROSSINGS_GPU = 2**24


def forward(volume: Tensor, rays: Rays, attenuation: Attenuation | None = None) -> Tensor:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`, attenuated towards their sources."""
    voxels = volume.reshape(-1)
    integrals = [(voxels[index] * weight).sum(dim=1) for _, index, weight, _ in _segments(volume, rays, attenuation)]
    return torch.cat(integrals) if integrals else volume.new_zeros(0)


def adjoint(volume: Tensor, values: Tensor, rays: Rays, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    for part, index, weight, _ in _segments(volume, rays, attenuation):
        _add(volume, index, weight * values[part, None])


def mu_gradient(gradient: Tensor, volume: Tensor, values: Tensor, rays: Rays, attenuation: Attenuation) -> None:
    """Add the derivative by mu of the integrals, each times its value of `values` (N,), to `gradient` in place.

    More mu on a segment of length s weakens all that comes from behind it by s, and what comes from the segment itself
    by the part of s that it has crossed on average.
    """
    voxels = volume.reshape(-1)
    for part, index, weight, (mu_index, length, depth) in _segments(volume, rays, attenuation):
        seen = voxels[index] * weight
        behind = _sum_onwards(seen) - seen
        slope = -length * (behind + _mean_place(depth) * seen)
        _add(gradient, mu_index, slope * values[part, None])


def derivatives(volume: Tensor, rays: Rays, attenuation: Attenuation | None = None) -> Tensor:
    """What the ends of `rays` do to their integrals (N, 7) or (N, 14), as `backends` describes it.

    Where a plane moves along the ray, the integral changes by the jump of the volume there, as far as that is seen, and
    by the jump of mu, which weakens all that comes from behind.
    """
    pieces = []
    lattices = _lattices(volume, rays, attenuation)
    (shape, line), (mu_shape, mu_line) = lattices[0], lattices[-1]
    counts = torch.tensor([2, *(n + 1 for shape, _ in lattices for n in shape)])
    axes = torch.arange(-1, 3 * len(lattices)).repeat_interleave(counts).to(volume.device)  # of the crossings
    mu_axes = 3 * (len(lattices) - 1)  # the first of mu's
    for part, alpha in _crossings(lattices):
        alpha, order = alpha.sort(dim=1)
        axis = axes[order]
        step = alpha.diff(dim=1)
        index, inside = _voxels_behind(shape, line.part(part), axis)
        value = volume.reshape(-1)[index].to(alpha.dtype).masked_fill_(~inside, 0.0)
        seen, jump = value * step, value[:, :-1] - value[:, 1:]
        of_mu = []
        if attenuation is not None:
            length = line.lengths[part, None]
            index, inside = _voxels_behind(mu_shape, mu_line.part(part), axis - mu_axes)
            mu = attenuation.mu.reshape(-1)[index].to(alpha.dtype).masked_fill_(~inside, 0.0)
            path = mu * step
            path_before = path.cumsum(dim=1) - path
            left = torch.exp(-length * path_before)
            seen *= left * _mean_transmission(length * path)
            jump *= left[:, 1:]
            mu_jump = -length * (mu[:, :-1] - mu[:, 1:]) * _sum_onwards(seen)[:, 1:]
            by_length = -(seen * (path_before + _mean_place(length * path) * path)).sum(dim=1, keepdim=True)
            of_mu = [_by_ends(mu_jump, alpha, axis - mu_axes, mu_line.part(part)), by_length]
        by_ends = _by_ends(jump, alpha, axis, line.part(part))
        pieces.append(torch.cat([seen.sum(dim=1, keepdim=True), by_ends, *of_mu], dim=1))
    width = 7 if attenuation is None else 14
    return torch.cat(pieces) if pieces else torch.zeros((0, width), dtype=volume.dtype, device=volume.device)


def _by_ends(jump: Tensor, alpha: Tensor, axis: Tensor, line: _Line) -> Tensor:
    """Derivatives (n, 6) by start and end of the rays, of what changes by `jump` (n, S - 1) per alpha of an inner cut.

    A plane at k is crossed at ``alpha = (k - s)/d``, d = t - s, so ``d alpha/ds = (alpha - 1)/d`` and ``d alpha/dt =
    -alpha/d``.
    """
    alpha, axis = alpha[:, 1:-1], axis[:, 1:-1]
    jump = jump.masked_fill((alpha <= 0) | (alpha >= 1), 0.0)  # the other planes are not met
    jumps = torch.stack([jump.masked_fill(axis != a, 0.0) for a in range(3)], dim=1)
    total, moment = jumps.sum(dim=2), (jumps * alpha[:, None]).sum(dim=2)
    over = torch.where(line.directions == 0, 1.0, line.directions)
    return torch.cat([(moment - total) / over, -moment / over], dim=1)


def _add(volume: Tensor, index: Tensor, values: Tensor) -> None:
    volume.reshape(-1).index_add_(0, index.reshape(-1), values.reshape(-1).to(volume.dtype))


def _segments(
    volume: Tensor, rays: Rays, attenuation: Attenuation | None
) -> Iterator[tuple[slice, Tensor, Tensor, tuple[Any, ...]]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), weight in mm (n, S).

    The weight is the segment's length, or, attenuated, the integral of exp(-integral of mu from the source) over it.
    A segment outside the volume has weight 0 and index 0. Last, where there is mu, the same of its lattice: flat voxel
    index, length of the segment, and mu times that (all (n, S)).
    """
    lattices = _lattices(volume, rays, attenuation)
    (shape, line), (mu_shape, mu_line) = lattices[0], lattices[-1]
    for part, alpha in _crossings(lattices):
        alpha = _sorted(alpha)
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2
        segment = alpha.diff(dim=1) * line.lengths[part, None]
        index, inside = _voxels(shape, line.part(part), middle)
        weight = segment.masked_fill(~inside, 0.0)
        of_mu: tuple[Any, ...] = ()
        if attenuation is not None:
            mu_index, inside = _voxels(mu_shape, mu_line.part(part), middle)
            length = segment.masked_fill_(~inside, 0.0)
            depth = attenuation.mu.reshape(-1)[mu_index] * length
            weight *= torch.exp(depth - depth.cumsum(dim=1)) * _mean_transmission(depth)
            of_mu = mu_index, length, depth
        yield part, index, weight, of_mu


@dataclass(frozen=True, eq=False)
class _Line:
    """`IndexRays` in tensors."""

    starts: Tensor
    directions: Tensor
    lengths: Tensor

    def part(self, which: slice) -> _Line:
        return _Line(self.starts[which], self.directions[which], self.lengths[which])


_Lattice = tuple[tuple[int, ...], _Line]  # a shape, and the rays in its index space


def _lattices(volume: Tensor, rays: Rays, attenuation: Attenuation | None) -> list[_Lattice]:
    """The volume's lattice, and mu's if that has its own."""
    real = torch.float32 if volume.device.type == "mps" else torch.float64  # Apple's GPUs have no float64

    def line(rays: Rays) -> _Line:
        listed = rays.listed()
        numbers = (listed.starts, listed.directions, listed.lengths)
        return _Line(*(torch.as_tensor(a, dtype=real).to(volume.device) for a in numbers))

    lattices = [(tuple(volume.shape), line(rays))]
    if attenuation is not None and attenuation.rays is not None:
        lattices.append((tuple(attenuation.mu.shape), line(attenuation.rays)))
    return lattices


def _crossings(lattices: list[_Lattice]) -> Iterator[tuple[slice, Tensor]]:
    """Where the rays cross the planes of all `lattices`, some rays at a time: which rays (a slice), alpha (n, S + 1).

    The first two are the rays' ends, 0 and 1; then come the planes, lattice by lattice, axis by axis.
    """
    lengths = lattices[0][1].lengths
    budget = _CROSSINGS_CPU if lengths.device.type == "cpu" else _CROSSINGS_GPU
    rays_at_once = max(1, budget // sum(sum(shape) + 5 for shape, _ in lattices))
    for first in range(0, len(lengths), rays_at_once):
        part = slice(first, first + rays_at_once)
        length = lengths[part, None]
        alpha = [torch.zeros_like(length), torch.ones_like(length)]
        for shape, line in lattices:
            for axis, n in enumerate(shape):
                s, d = line.starts[part, axis, None], line.directions[part, axis, None]
                parallel = d == 0
                planes = torch.arange(n + 1, dtype=s.dtype, device=s.device)
                # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
                crossings = ((planes - s) / torch.where(parallel, 1.0, d)).clamp_(0.0, 1.0)
                alpha.append(crossings.masked_fill_(parallel, 0.0))
        yield part, torch.cat(alpha, dim=1)


def _sorted(alpha: Tensor) -> Tensor:
    """`alpha` (n, S), every row sorted."""
    if alpha.device.type == "cpu":  # torch would sort the order as well, in four times the time
        return torch.from_numpy(np.sort(alpha.numpy(), axis=1))
    return alpha.sort(dim=1).values


def _voxels(shape: tuple[int, ...], line: _Line, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Flat index of the voxel in which each of the points `alpha` (n, S) of the rays lies, and whether it lies in any.

    The index of a point in no voxel is 0.
    """
    return _flat(shape, (torch.floor(line.starts[:, a, None] + alpha * line.directions[:, a, None]) for a in range(3)))


def _voxels_behind(shape: tuple[int, ...], line: _Line, axis: Tensor) -> tuple[Tensor, Tensor]:
    """As `_voxels`, of the segments behind all but the last of the planes crossed, whose axes are `axis` (n, S + 1).

    A voxel follows from the number of planes crossed. Where planes of two lattices, or an edge, are met, the segment
    between has no length, and its midpoint would tell nothing.
    """

    def voxels() -> Iterator[Tensor]:
        for a, n in enumerate(shape):
            crossed = (axis[:, :-1] == a).cumsum(dim=1)
            start, direction = line.starts[:, a, None], line.directions[:, a, None]
            voxel = torch.where(direction > 0, crossed - 1, n - crossed)
            yield torch.where(direction == 0, start.floor().to(torch.int64), voxel)

    return _flat(shape, voxels())


def _flat(shape: tuple[int, ...], voxels: Iterable[Tensor]) -> tuple[Tensor, Tensor]:
    """Flat index of voxels given axis by axis, and whether there is such a voxel; the index of none is 0."""
    index: Any = 0
    inside: Any = True
    for n, voxel in zip(shape, voxels, strict=True):
        inside = (voxel >= 0) & (voxel < n) & inside
        index = voxel.clamp_(0, n - 1).to(torch.int64) + index * n
    return index.masked_fill_(~inside, 0), inside


def _sum_onwards(seen: Tensor) -> Tensor:
    """For every segment the sum of `seen` (n, S) over it and those behind it."""
    return seen.flip(1).cumsum(dim=1).flip(1)


def _mean_transmission(depth: Tensor) -> Tensor:
    """Mean of exp(-t) over t from 0 to `depth`: (1 - exp(-depth)) / depth, 1 at 0."""
    return torch.where(depth != 0, -torch.expm1(-depth) / torch.where(depth != 0, depth, 1.0), 1.0)


def _mean_place(depth: Tensor) -> Tensor:
    """Mean of t with the weight exp(-t) over t from 0 to `depth`, in units of `depth`: 1/2 at 0."""
    square = depth**2
    series = 1 / 2 - depth / 12 * (1 - square / 60 * (1 - square / 42))  # what is left out: 1e-13 below 0.1
    thick = torch.where(depth < 0.1, 1.0, depth)
    return torch.where(depth < 0.1, series, 1 / thick + torch.exp(-thick) / torch.expm1(-thick))
