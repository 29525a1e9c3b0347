"""Siddon's line integrals in numpy: the float64 reference, written to be read.

R. L. Siddon, "Fast calculation of the exact radiological path for a three-dimensional CT array", Medical
Physics 12 (1985) 252-255: a ray's crossings with all planes of voxel faces, sorted, cut it into segments; a
segment's midpoint tells its voxel. What attenuates has its own lattice, whose planes cut the ray too, so every
segment lies in one voxel of each. `siddon_torch` is the same in torch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rays import Attenuation, IndexRays, Rays

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]
Lattice = tuple[tuple[int, ...], IndexRays]  # a shape, and the rays in its index space

# Crossings held at once: some ten arrays of this many float64 exist at the same time.
_CROSSINGS = 2**18


def forward(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`, attenuated towards their sources."""
    integrals = np.empty(len(rays))
    voxels = volume.reshape(-1)
    for part, index, weight, _ in _segments(volume.shape, rays, attenuation):
        integrals[part] = (voxels[index] * weight).sum(axis=1)
    return integrals


def adjoint(volume: Array, values: Array, rays: Rays, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    voxels = volume.reshape(-1)
    for part, index, weight, _ in _segments(volume.shape, rays, attenuation):
        np.add.at(voxels, index, weight * values[part, None])


def mu_gradient(gradient: Array, volume: Array, values: Array, rays: Rays, attenuation: Attenuation) -> None:
    """Add the derivative by mu of the integrals, each times its value of `values` (N,), to `gradient` in place.

    More mu on a segment of length s weakens all that comes from behind it by s, and what comes from the segment itself
    by the part of s that it has crossed on average.
    """
    voxels = volume.reshape(-1)
    for part, index, weight, (mu_index, length, depth) in _segments(volume.shape, rays, attenuation):
        seen = voxels[index] * weight
        behind = _sum_onwards(seen) - seen
        slope = -length * (behind + _mean_place(depth) * seen)
        np.add.at(gradient.reshape(-1), mu_index, slope * values[part, None])


def derivatives(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """What the ends of `rays` do to their integrals (N, 7) or (N, 14), as `backends` describes it.

    Where a plane moves along the ray, the integral changes by the jump of the volume there, as far as that is seen, and
    by the jump of mu, which weakens all that comes from behind.
    """
    lattices = _lattices(volume.shape, rays, attenuation)
    (_, rays), (mu_shape, mu_rays) = lattices[0], lattices[-1]
    counts = [2, *(n + 1 for shape, _ in lattices for n in shape)]
    axes = np.repeat(np.arange(-1, 3 * len(lattices)), counts)  # of the crossings
    mu_axes = 3 * (len(lattices) - 1)  # the first of mu's
    result = np.zeros((len(rays), 7 if attenuation is None else 14))
    for part, alpha in _crossings(lattices):
        order = alpha.argsort(axis=1)
        alpha, axis = np.take_along_axis(alpha, order, axis=1), axes[order]
        step = np.diff(alpha, axis=1)
        index, inside = _voxels_behind(volume.shape, rays[part], axis)
        value = np.where(inside, volume.reshape(-1)[index], 0.0)
        seen, jump = value * step, value[:, :-1] - value[:, 1:]
        if attenuation is not None:
            length = rays.lengths[part, None]
            index, inside = _voxels_behind(mu_shape, mu_rays[part], axis - mu_axes)
            mu = np.where(inside, attenuation.mu.reshape(-1)[index], 0.0)
            path = mu * step
            path_before = np.cumsum(path, axis=1) - path
            left = np.exp(-length * path_before)
            seen *= left * _mean_transmission(length * path)
            jump *= left[:, 1:]
            mu_jump = -length * (mu[:, :-1] - mu[:, 1:]) * _sum_onwards(seen)[:, 1:]
            result[part, 7:13] = _by_ends(mu_jump, alpha, axis - mu_axes, mu_rays[part])
            result[part, 13] = -(seen * (path_before + _mean_place(length * path) * path)).sum(axis=1)
        result[part, 0] = seen.sum(axis=1)
        result[part, 1:7] = _by_ends(jump, alpha, axis, rays[part])
    return result


def _by_ends(jump: Array, alpha: Array, axis: Indices, rays: IndexRays) -> Array:
    """Derivatives (n, 6) by start and end of the rays, of what changes by `jump` (n, S - 1) per alpha of an inner cut.

    A plane at k is crossed at ``alpha = (k - s)/d``, d = t - s, so ``d alpha/ds = (alpha - 1)/d`` and ``d alpha/dt =
    -alpha/d``.
    """
    alpha, axis = alpha[:, 1:-1], axis[:, 1:-1]
    jump = np.where((alpha > 0) & (alpha < 1), jump, 0.0)  # the other planes are not met
    jumps = np.stack([np.where(axis == a, jump, 0.0) for a in range(3)], axis=1)
    total, moment = jumps.sum(axis=2), (jumps * alpha[:, None]).sum(axis=2)
    over = np.where(rays.directions == 0, 1.0, rays.directions)
    return np.concatenate([(moment - total) / over, -moment / over], axis=1)


def _segments(
    shape: tuple[int, ...], rays: Rays, attenuation: Attenuation | None
) -> Iterator[tuple[slice, Indices, Array, tuple[Any, ...]]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), weight in mm (n, S).

    The weight is the segment's length, or, attenuated, the integral of exp(-integral of mu from the source) over it.
    A segment outside the volume has weight 0 and index 0. Last, where there is mu, the same of its lattice: flat voxel
    index, length of the segment, and mu times that (all (n, S)).
    """
    lattices = _lattices(shape, rays, attenuation)
    (_, rays), (mu_shape, mu_rays) = lattices[0], lattices[-1]
    for part, alpha in _crossings(lattices):
        alpha.sort(axis=1)
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2
        segment = np.diff(alpha, axis=1) * rays.lengths[part, None]
        index, inside = _voxels(shape, rays[part], middle)
        weight = np.where(inside, segment, 0.0)
        of_mu: tuple[Any, ...] = ()
        if attenuation is not None:
            mu_index, inside = _voxels(mu_shape, mu_rays[part], middle)
            length = np.where(inside, segment, 0.0)
            depth = attenuation.mu.reshape(-1)[mu_index] * length
            weight *= np.exp(depth - np.cumsum(depth, axis=1)) * _mean_transmission(depth)
            of_mu = mu_index, length, depth
        yield part, index, weight, of_mu


def _lattices(shape: tuple[int, ...], rays: Rays, attenuation: Attenuation | None) -> list[Lattice]:
    """The volume's lattice, and mu's if that has its own."""
    lattices = [(shape, rays.listed())]
    if attenuation is not None and attenuation.rays is not None:
        lattices.append((attenuation.mu.shape, attenuation.rays.listed()))
    return lattices


def _crossings(lattices: list[Lattice]) -> Iterator[tuple[slice, Array]]:
    """Where the rays cross the planes of all `lattices`, some rays at a time: which rays (a slice), alpha (n, S + 1).

    The first two are the rays' ends, 0 and 1; then come the planes, lattice by lattice, axis by axis.
    """
    lengths = lattices[0][1].lengths
    rays_at_once = max(1, _CROSSINGS // sum(sum(shape) + 5 for shape, _ in lattices))
    for first in range(0, len(lengths), rays_at_once):
        part = slice(first, first + rays_at_once)
        length = lengths[part, None]
        alpha = [np.zeros_like(length), np.ones_like(length)]
        for shape, rays in lattices:
            for axis, n in enumerate(shape):
                s, d = rays.starts[part, axis, None], rays.directions[part, axis, None]
                parallel = d == 0
                # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
                crossings = np.clip((np.arange(n + 1) - s) / np.where(parallel, 1.0, d), 0.0, 1.0)
                alpha.append(np.where(parallel, 0.0, crossings))
        yield part, np.concatenate(alpha, axis=1)


def _voxels(shape: tuple[int, ...], rays: IndexRays, alpha: Array) -> tuple[Indices, Flags]:
    """Flat index of the voxel in which each of the points `alpha` (n, S) of the rays lies, and whether it lies in any.

    The index of a point in no voxel is 0.
    """
    return _flat(shape, (np.floor(rays.starts[:, a, None] + alpha * rays.directions[:, a, None]) for a in range(3)))


def _voxels_behind(shape: tuple[int, ...], rays: IndexRays, axis: Indices) -> tuple[Indices, Flags]:
    """As `_voxels`, of the segments behind all but the last of the planes crossed, whose axes are `axis` (n, S + 1).

    A voxel follows from the number of planes crossed. Where planes of two lattices, or an edge, are met, the segment
    between has no length, and its midpoint would tell nothing.
    """

    def voxels() -> Iterator[Array]:
        for a, n in enumerate(shape):
            crossed = np.cumsum(axis[:, :-1] == a, axis=1)
            start, direction = rays.starts[:, a, None], rays.directions[:, a, None]
            voxel = np.where(direction > 0, crossed - 1, n - crossed)
            yield np.where(direction == 0, np.floor(start), voxel)

    return _flat(shape, voxels())


def _flat(shape: tuple[int, ...], voxels: Iterable[Array]) -> tuple[Indices, Flags]:
    """Flat index of voxels given axis by axis, and whether there is such a voxel; the index of none is 0."""
    index: Any = 0
    inside: Any = True
    for n, voxel in zip(shape, voxels, strict=True):
        inside = inside & (voxel >= 0) & (voxel < n)
        index = index * n + np.clip(voxel, 0, n - 1).astype(np.intp)
    index[~inside] = 0
    return index, inside


def _sum_onwards(seen: Array) -> Array:
    """For every segment the sum of `seen` (n, S) over it and those behind it."""
    return np.cumsum(seen[:, ::-1], axis=1)[:, ::-1]


def _mean_transmission(depth: Array) -> Array:
    """Mean of exp(-t) over t from 0 to `depth`: (1 - exp(-depth)) / depth, 1 at 0."""
    return np.divide(-np.expm1(-depth), depth, out=np.ones_like(depth), where=depth != 0)


def _mean_place(depth: Array) -> Array:
    """Mean of t with the weight exp(-t) over t from 0 to `depth`, in units of `depth`: 1/2 at 0."""
    square = depth**2
    series = 1 / 2 - depth / 12 * (1 - square / 60 * (1 - square / 42))  # what is left out: 1e-13 below 0.1
    thick = np.where(depth < 0.1, 1.0, depth)
    return np.where(depth < 0.1, series, 1 / thick + np.exp(-thick) / np.expm1(-thick))
