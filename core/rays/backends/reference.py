"""The backends numpy and torch: Siddon's line integrals written to be read, the reference of the others.

R. L. Siddon, "Fast calculation of the exact radiological path for a three-dimensional CT array", Medical
Physics 12 (1985) 252-255: a ray's crossings with all planes of voxel faces, sorted, cut it into segments; the midpoint of a
segment determines its voxel. Attenuation has its own lattice, whose planes cut the ray too, so every segment lies in one
voxel of each.

The functions compute in numpy or torch, whichever the volume is of. All planes are crossed at once and sorted, which suits a
GPU and is slow on a CPU. Geometry is float64. Gradients are not recorded here: `autograd` calls `backproject`, `mu_gradient`
and `derivatives`, so that there is no graph of segments.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ...arrays import ArrayOrTensor as Array
from ...arrays import is_tensor, namespace
from ..ray_geometry import Attenuation, Rays

# Largest number of crossings in memory, on a CPU and on a GPU; about ten float64 arrays of this size exist at the same time.
_CROSSINGS_CPU = 2**17
_CROSSINGS_GPU = 2**24


def forward(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """Return line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z), attenuated towards the rays' sources."""
    voxels = volume.reshape(-1)
    integrals = [(voxels[s.voxel] * s.weight).sum(1) for s in _segments(volume, rays, attenuation)]
    return namespace(volume).concatenate(integrals)


def backproject(volume: Array, values: Array, rays: Rays, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    for s in _segments(volume, rays, attenuation):
        _add(volume, s.voxel, s.weight * values[s.rays, None])


def mu_gradient(gradient: Array, volume: Array, values: Array, rays: Rays, attenuation: Attenuation) -> None:
    """Add the gradient by mu of the sum of `values` (N,) times the integrals to `gradient`, of mu's shape, in place.

    More mu on a segment of length s attenuates all photons from beyond it by s, and those of the segment itself by the part
    of s that they have crossed on average.
    """
    voxels = volume.reshape(-1)
    for s in _segments(volume, rays, attenuation):
        detected = voxels[s.voxel] * s.weight
        beyond = _sum_onwards(detected) - detected
        slope = -s.length_in_mu * (beyond + _mean_depth(s.optical_depth) * detected)
        _add(gradient, s.mu_voxel, slope * values[s.rays, None])


def derivatives(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """Return the integrals over alpha and their derivatives by the ends of `rays`, (N, 7) or (N, 14), as in `backends`.

    When a plane moves along the ray, the integral changes by the volume's jump there, times the transmittance, and
    by the jump of mu, which attenuates all photons from beyond.
    """
    xp = namespace(volume)
    lattices = _lattices(volume, rays, attenuation)
    first, last = lattices[0], lattices[-1]
    counts = [2, *(n + 1 for lattice in lattices for n in lattice.shape)]
    axes = _as_volume(np.repeat(np.arange(-1, 3 * len(lattices)), counts), volume)  # of the crossings
    mu_axes = 3 * (len(lattices) - 1)  # the first of mu's
    pieces = []
    for part, alpha in _crossings(lattices):
        order = alpha.argsort(1)
        alpha, axis = alpha[xp.arange(len(alpha), **_device_option(alpha))[:, None], order], axes[order]
        step = xp.diff(alpha)
        value = _values(volume, _voxels_beyond(first.part(part), axis), alpha)
        detected, jump = value * step, value[:, :-1] - value[:, 1:]
        mu_columns = []
        if attenuation is not None:
            length = first.lengths[part, None]
            mu = _values(attenuation.mu, _voxels_beyond(last.part(part), axis - mu_axes), alpha)
            depth = mu * step  # optical depth per mm of the ray's length
            depth_before = xp.cumsum(depth, 1) - depth
            transmittance = xp.exp(-length * depth_before)
            detected *= transmittance * _mean_transmittance(length * depth)
            jump *= transmittance[:, 1:]
            mu_jump = -length * (mu[:, :-1] - mu[:, 1:]) * _sum_onwards(detected)[:, 1:]
            d_length = -(detected * (depth_before + _mean_depth(length * depth) * depth)).sum(1)
            mu_columns = [_ends_derivatives(mu_jump, alpha, axis - mu_axes, last.part(part)), d_length[:, None]]
        d_ends = _ends_derivatives(jump, alpha, axis, first.part(part))
        pieces.append(xp.concatenate([detected.sum(1)[:, None], d_ends, *mu_columns], 1))
    return xp.concatenate(pieces)


def _ends_derivatives(jump: Array, alpha: Array, axis: Array, lattice: _LatticeRays) -> Array:
    """Return the derivatives (n, 6) by start and end of rays whose integrand jumps by `jump` (n, S - 1) at inner cuts.

    A plane at k is crossed at ``alpha = (k - s)/d``, d = t - s, so ``d alpha/ds = (alpha - 1)/d`` and ``d alpha/dt =
    -alpha/d``.
    """
    xp = namespace(jump)
    alpha, axis = alpha[:, 1:-1], axis[:, 1:-1]
    jump = xp.where((alpha > 0) & (alpha < 1), jump, 0.0)  # the ray does not meet the other planes
    jumps = xp.stack([xp.where(axis == a, jump, 0.0) for a in range(3)], 1)
    total, moment = jumps.sum(2), (jumps * alpha[:, None]).sum(2)
    divisor = xp.where(lattice.directions == 0, 1.0, lattice.directions)
    return xp.concatenate([(moment - total) / divisor, -moment / divisor], 1)


class _Segments(NamedTuple):
    """Segments (n, S) of some rays; outside a lattice the voxel is 0 and the weight or length 0."""

    rays: slice
    """Numbers of the rays."""
    voxel: Array
    """Flat indices in the volume."""
    weight: Array
    """Lengths, mm, or with attenuation the integral of exp(-integral of mu from the source) over the segment."""
    mu_voxel: Any = None
    """Flat indices in mu."""
    length_in_mu: Any = None
    """Lengths within the lattice of mu, mm."""
    optical_depth: Any = None
    """Optical depths of the segments, mu times length."""


def _segments(volume: Array, rays: Rays, attenuation: Attenuation | None) -> Iterator[_Segments]:
    """Yield the segments of the rays, some rays at a time."""
    xp = namespace(volume)
    lattices = _lattices(volume, rays, attenuation)
    first, last = lattices[0], lattices[-1]
    for part, alpha in _crossings(lattices):
        alpha = _sorted(alpha)
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2
        length = xp.diff(alpha)
        length *= first.lengths[part, None]
        voxel, inside = _voxels(first.part(part), middle)
        weight = length * inside
        if attenuation is None:
            yield _Segments(part, voxel, weight)
            continue
        mu_voxel, inside = _voxels(last.part(part), middle)
        length *= inside
        depth = attenuation.mu.reshape(-1)[mu_voxel] * length
        weight *= xp.exp(depth - xp.cumsum(depth, 1)) * _mean_transmittance(depth)
        yield _Segments(part, voxel, weight, mu_voxel, length, depth)


@dataclass(frozen=True, eq=False)
class _LatticeRays:
    """Shape of a lattice, and `IndexRays` in its index space as arrays of the volume's kind."""

    shape: tuple[int, ...]
    """Number of voxels along each axis."""
    starts: Array
    """(N, 3), `IndexRays.starts`."""
    directions: Array
    """(N, 3), `IndexRays.directions`."""
    lengths: Array
    """(N,), `IndexRays.lengths`."""

    def part(self, rays: slice) -> _LatticeRays:
        """Return some of the rays."""
        return _LatticeRays(self.shape, self.starts[rays], self.directions[rays], self.lengths[rays])


def _lattices(volume: Array, rays: Rays, attenuation: Attenuation | None) -> list[_LatticeRays]:
    """Return the rays in the volume's lattice, and in that of mu if mu has its own."""

    def lattice(array: Array, rays: Rays) -> _LatticeRays:
        """Return the rays in the lattice of `array`."""
        listed = rays.listed()
        numbers = (listed.starts, listed.directions, listed.lengths)
        return _LatticeRays(tuple(array.shape), *(_as_volume(x, volume) for x in numbers))

    lattices = [lattice(volume, rays)]
    if attenuation is not None and attenuation.rays is not None:
        lattices.append(lattice(attenuation.mu, attenuation.rays))
    return lattices


def _crossings(lattices: list[_LatticeRays]) -> Iterator[tuple[slice, Array]]:
    """Yield the crossings alpha (n, S + 1) of some rays with the planes of all `lattices`, after a slice of their numbers.

    The first two are the rays' ends, 0 and 1; then come the planes, lattice by lattice, axis by axis.
    """
    lengths = lattices[0].lengths
    xp, device = namespace(lengths), _device_option(lengths)
    budget = _CROSSINGS_CPU if not is_tensor(lengths) or lengths.device.type == "cpu" else _CROSSINGS_GPU
    rays_at_once = max(1, budget // sum(sum(lattice.shape) + 5 for lattice in lattices))
    for first in range(0, max(1, len(lengths)), rays_at_once):  # once if there are no rays
        part = slice(first, first + rays_at_once)
        length = lengths[part, None]
        alpha = [xp.zeros_like(length), xp.ones_like(length)]
        for lattice in lattices:
            for axis, n in enumerate(lattice.shape):
                start, direction = lattice.starts[part, axis, None], lattice.directions[part, axis, None]
                parallel = direction == 0
                crossings = xp.arange(n + 1, dtype=lengths.dtype, **device) - start
                crossings /= xp.where(parallel, 1.0, direction)
                # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
                xp.clip(crossings, 0.0, 1.0, out=crossings)
                crossings *= ~parallel
                alpha.append(crossings)
        yield part, xp.concatenate(alpha, 1)


def _voxels(lattice: _LatticeRays, alpha: Array) -> tuple[Array, Array]:
    """Return the flat index of the voxel of each of the points `alpha` (n, S) of the rays, and whether it is in a voxel.

    The index of a point in no voxel is 0.
    """
    xp = namespace(alpha)

    def voxels() -> Iterator[Array]:
        """Yield the points' voxel indices (n, S) axis by axis."""
        for a in range(3):
            coordinate = alpha * lattice.directions[:, a, None]
            coordinate += lattice.starts[:, a, None]
            yield xp.floor(coordinate, out=coordinate)

    return _flat(lattice.shape, voxels())


def _voxels_beyond(lattice: _LatticeRays, axis: Array) -> tuple[Array, Array]:
    """Return the flat index of the voxel of each segment, and whether it is in a voxel, from the planes that were crossed.

    The axes of these planes are `axis` (n, S + 1); each but the last begins a segment. A voxel follows from the number of
    planes crossed. Where planes of two lattices, or an edge, are met, the segment between has no length, and its midpoint
    would not determine a voxel.
    """
    xp = namespace(axis)

    def voxels() -> Iterator[Array]:
        """Yield the segments' voxel indices (n, S) axis by axis."""
        for a, n in enumerate(lattice.shape):
            crossed = xp.cumsum(axis[:, :-1] == a, 1)
            start, direction = lattice.starts[:, a, None], lattice.directions[:, a, None]
            voxel = xp.where(direction > 0, crossed - 1, n - crossed)
            yield xp.where(direction == 0, xp.floor(start), voxel)

    return _flat(lattice.shape, voxels())


def _flat(shape: tuple[int, ...], voxels: Iterable[Array]) -> tuple[Array, Array]:
    """Return the flat index of voxels given axis by axis, and whether there is such a voxel; the index of none is 0."""
    index: Any = 0
    inside: Any = True
    for n, voxel in zip(shape, voxels, strict=True):
        inside = (voxel >= 0) & (voxel < n) & inside
        index = index * n + voxel
    index = namespace(index).where(inside, index, 0)
    return (index.long() if is_tensor(index) else index.astype(np.intp)), inside


def _values(array: Array, voxels: tuple[Array, Array], alpha: Array) -> Array:
    """Return the values of `array` in the voxels of a flat index, 0 where there is none, in the type of `alpha`."""
    index, inside = voxels
    values = array.reshape(-1)[index]
    return (values.to(alpha.dtype) if is_tensor(values) else values.astype(alpha.dtype, copy=False)) * inside


def _sum_onwards(detected: Array) -> Array:
    """Return for every segment the sum of `detected` (n, S) over it and the segments beyond it."""
    xp = namespace(detected)
    return xp.flip(xp.cumsum(xp.flip(detected, (1,)), 1), (1,))


def _mean_transmittance(depth: Array) -> Array:
    """Return the mean of exp(-t) over t from 0 to `depth`: (1 - exp(-depth)) / depth, 1 at 0."""
    xp = namespace(depth)
    is_zero = depth == 0
    mean = xp.expm1(-depth)
    mean /= xp.where(is_zero, -1.0, -depth)
    mean += is_zero
    return mean


def _mean_depth(depth: Array) -> Array:
    """Return the mean of t with the weight exp(-t) over t from 0 to `depth`, in units of `depth`: 1/2 at 0."""
    xp = namespace(depth)
    square = depth**2
    series = 1 / 2 - depth / 12 * (1 - square / 60 * (1 - square / 42))  # the error is below 1e-13 for depths below 0.1
    thick = xp.where(depth < 0.1, 1.0, depth)
    return xp.where(depth < 0.1, series, 1 / thick + xp.exp(-thick) / xp.expm1(-thick))


# Functions that numpy and torch call differently.


def _as_volume(numbers: np.ndarray[Any, Any], volume: Array) -> Array:
    """Return `numbers` as an array or tensor as `volume` is, on its device, in their own type."""
    if not is_tensor(volume):
        return numbers
    import torch

    numbers = np.ascontiguousarray(numbers)
    if volume.device.type == "mps" and numbers.dtype == np.float64:  # Apple's GPUs have no float64
        numbers = numbers.astype(np.float32)
    return torch.from_numpy(numbers).to(volume.device)


def _device_option(array: Array) -> dict[str, Any]:
    """Return the option of new tensors that puts them on the device of a tensor; none for an array."""
    return {"device": array.device} if is_tensor(array) else {}


def _sorted(alpha: Array) -> Array:
    """Return `alpha` (n, S) with every row sorted, an array in place."""
    if not is_tensor(alpha):
        alpha.sort(axis=1)
        return alpha
    if alpha.device.type == "cpu":  # torch would compute the order as well, in four times the time
        return namespace(alpha).from_numpy(np.sort(alpha.numpy(), axis=1))
    return alpha.sort(dim=1).values


def _add(volume: Array, index: Array, values: Array) -> None:
    """Add `values` to the voxels of a flat `index`, in place."""
    if is_tensor(volume):
        volume.reshape(-1).index_add_(0, index.reshape(-1), values.reshape(-1).to(volume.dtype))
    else:
        np.add.at(volume.reshape(-1), index, values)
