"""Siddon's line integrals in numpy: the float64 reference, written to be read.

R. L. Siddon, "Fast calculation of the exact radiological path for a three-dimensional CT array", Medical
Physics 12 (1985) 252-255: a ray's crossings with all planes of voxel faces, sorted, cut it into segments; a
segment's midpoint tells its voxel. What attenuates has its own lattice, whose planes cut the ray too, so every
segment lies in one voxel of each. `siddon_torch` is the same in torch.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .rays import Attenuation, IndexFan, IndexRays

Array = NDArray[np.float64]

# Crossings held at once: some ten arrays of this many float64 exist at the same time.
_CROSSINGS = 2**18


def forward(volume: Array, rays: IndexRays | IndexFan, attenuation: Attenuation | None = None) -> Array:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`, attenuated towards their sources."""
    integrals = np.empty(len(rays))
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume.shape, rays, attenuation):
        integrals[part] = (voxels[index] * weight).sum(axis=1)
    return integrals


def adjoint(volume: Array, values: Array, rays: IndexRays | IndexFan, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume.shape, rays, attenuation):
        np.add.at(voxels, index, weight * values[part, None])


def derivatives(volume: Array, rays: IndexRays | IndexFan) -> Array:
    """What the ends of `rays` do to their integrals (N, 7), as `backends` describes it."""
    rays = rays.listed()
    result = np.zeros((len(rays), 7))
    voxels = volume.reshape(-1)
    axes = np.repeat([3, 0, 1, 2], [2, *(n + 1 for n in volume.shape)])  # of the crossings; 3: the ray's ends
    for part, alpha, middle, order in _cut([(volume.shape, rays)]):
        index, inside = _voxels(volume.shape, rays[part], middle)
        value = np.where(inside, voxels[index], 0.0)
        result[part, 0] = (value * np.diff(alpha, axis=1)).sum(axis=1)
        # A plane at k is crossed at alpha = (k - s)/d, d = t - s: d alpha/ds = (alpha - 1)/d, d alpha/dt = -alpha/d.
        alpha, axis = alpha[:, 1:-1], axes[order[:, 1:-1]]
        jump = np.where((alpha > 0) & (alpha < 1), value[:, :-1] - value[:, 1:], 0.0)
        for a in range(3):
            direction = rays.directions[part, a]
            over = np.where(direction == 0, 1.0, direction)
            jumps = np.where(axis == a, jump, 0.0)
            result[part, 1 + a] = (jumps * (alpha - 1)).sum(axis=1) / over
            result[part, 4 + a] = -(jumps * alpha).sum(axis=1) / over
    return result


def _segments(
    shape: tuple[int, ...], rays: IndexRays | IndexFan, attenuation: Attenuation | None
) -> Iterator[tuple[slice, NDArray[np.intp], Array]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), weight in mm (n, S).

    The weight is the segment's length, or, attenuated, the integral of exp(-integral of mu from the source) over it.
    A segment outside the volume has weight 0 and index 0.
    """
    rays = mu_rays = rays.listed()
    lattices = [(shape, rays)]
    if attenuation is not None and attenuation.rays is not None:
        mu_rays = attenuation.rays.listed()
        lattices.append((attenuation.mu.shape, mu_rays))
    for part, alpha, middle, _ in _cut(lattices):
        segment = np.diff(alpha, axis=1) * rays.lengths[part, None]
        index, inside = _voxels(shape, rays[part], middle)
        weight = np.where(inside, segment, 0.0)
        if attenuation is not None:
            mu_index, inside = _voxels(attenuation.mu.shape, mu_rays[part], middle)
            depth = np.where(inside, attenuation.mu.reshape(-1)[mu_index], 0.0) * segment
            weight *= np.exp(depth - np.cumsum(depth, axis=1)) * _mean_transmission(depth)
        yield part, index, weight


def _cut(
    lattices: list[tuple[tuple[int, ...], IndexRays]],
) -> Iterator[tuple[slice, Array, Array, NDArray[np.intp]]]:
    """The rays cut at the planes of all `lattices`, each a shape and the rays there, some rays at a time.

    Yields which rays (a slice), alpha of the cuts (n, S + 1) and of the segments' midpoints (n, S), and which crossing
    each cut is (n, S + 1), counted from 2 in the order of `_crossings`; 0 and 1 are the ray's ends.
    """
    lengths = lattices[0][1].lengths
    rays_at_once = max(1, _CROSSINGS // sum(sum(shape) + 5 for shape, _ in lattices))
    for first in range(0, len(lengths), rays_at_once):
        part = slice(first, first + rays_at_once)
        length = lengths[part, None]
        crossings = [np.zeros_like(length), np.ones_like(length)]
        for shape, rays in lattices:
            crossings += _crossings(shape, rays[part])
        alpha = np.concatenate(crossings, axis=1)
        order = alpha.argsort(axis=1)
        alpha = np.take_along_axis(alpha, order, axis=1)
        yield part, alpha, (alpha[:, 1:] + alpha[:, :-1]) / 2, order


def _crossings(shape: tuple[int, ...], rays: IndexRays) -> Iterator[Array]:
    """Where the rays cross a lattice's planes, axis by axis: alpha (N, n + 1)."""
    for axis, n in enumerate(shape):
        s, d = rays.starts[:, axis, None], rays.directions[:, axis, None]
        parallel = d == 0
        # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
        alpha = np.clip((np.arange(n + 1) - s) / np.where(parallel, 1.0, d), 0.0, 1.0)
        yield np.where(parallel, 0.0, alpha)


def _voxels(shape: tuple[int, ...], rays: IndexRays, alpha: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Flat index of the voxel in which each of the points `alpha` (N, S) of the rays lies, and whether it lies in any.

    The index of a point in no voxel is 0.
    """
    index = np.zeros(alpha.shape, dtype=np.intp)
    inside = np.ones(alpha.shape, dtype=bool)
    for axis, n in enumerate(shape):
        voxel = np.floor(rays.starts[:, axis, None] + alpha * rays.directions[:, axis, None])
        inside &= (voxel >= 0) & (voxel < n)
        index = index * n + np.clip(voxel, 0, n - 1).astype(np.intp)
    index[~inside] = 0
    return index, inside


def _mean_transmission(depth: Array) -> Array:
    """Mean of exp(-t) over t from 0 to `depth`: (1 - exp(-depth)) / depth, 1 at 0."""
    return np.divide(-np.expm1(-depth), depth, out=np.ones_like(depth), where=depth != 0)
