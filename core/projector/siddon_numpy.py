"""Siddon's line integrals in numpy: the float64 reference, written to be read.

R. L. Siddon, "Fast calculation of the exact radiological path for a three-dimensional CT array", Medical
Physics 12 (1985) 252-255: a ray's crossings with all planes of voxel faces, sorted, cut it into segments; a
segment's midpoint tells its voxel. `siddon_torch` is the same in torch.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .rays import IndexRays

Array = NDArray[np.float64]

# Crossings held at once: some ten arrays of this many float64 exist at the same time.
_CROSSINGS = 2**18


def forward(volume: Array, rays: IndexRays) -> Array:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`."""
    integrals = np.empty(len(rays))
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume.shape, rays):
        integrals[part] = (voxels[index] * weight).sum(axis=1)
    return integrals


def adjoint(volume: Array, values: Array, rays: IndexRays) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    voxels = volume.reshape(-1)
    for part, index, weight in _segments(volume.shape, rays):
        np.add.at(voxels, index, weight * values[part, None])


def derivatives(volume: Array, rays: IndexRays) -> Array:
    """What the ends of `rays` do to their integrals (N, 7), as `backends` describes it."""
    result = np.zeros((len(rays), 7))
    voxels = volume.reshape(-1)
    for part, index, inside, alpha, axis in _cut(volume.shape, rays):
        value = np.where(inside, voxels[index], 0.0)
        result[part, 0] = (value * np.diff(alpha, axis=1)).sum(axis=1)
        # A plane at k is crossed at alpha = (k - s)/d, d = t - s: d alpha/ds = (alpha - 1)/d, d alpha/dt = -alpha/d.
        alpha, axis = alpha[:, 1:-1], axis[:, 1:-1]
        jump = np.where((alpha > 0) & (alpha < 1), value[:, :-1] - value[:, 1:], 0.0)
        for a in range(3):
            direction = rays.directions[part, a]
            over = np.where(direction == 0, 1.0, direction)
            jumps = np.where(axis == a, jump, 0.0)
            result[part, 1 + a] = (jumps * (alpha - 1)).sum(axis=1) / over
            result[part, 4 + a] = -(jumps * alpha).sum(axis=1) / over
    return result


def _segments(shape: tuple[int, ...], rays: IndexRays) -> Iterator[tuple[slice, NDArray[np.intp], Array]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), length in mm (n, S).

    A segment outside the volume has length 0 and index 0.
    """
    for part, index, inside, alpha, _ in _cut(shape, rays):
        yield part, index, np.where(inside, np.diff(alpha, axis=1) * rays.lengths[part, None], 0.0)


def _cut(
    shape: tuple[int, ...], rays: IndexRays
) -> Iterator[tuple[slice, NDArray[np.intp], NDArray[np.bool_], Array, NDArray[np.intp]]]:
    """The rays cut at their crossings, some rays at a time.

    Yields which rays (a slice); of each segment the flat voxel index (n, S), 0 outside, and whether it is inside
    (n, S); of each cut its alpha (n, S + 1) and the axis of the plane (n, S + 1), 3 at the ray's ends.
    """
    axes = np.repeat([3, 0, 1, 2], [2, *(n + 1 for n in shape)])
    rays_at_once = max(1, _CROSSINGS // (sum(shape) + 5))
    for first in range(0, len(rays), rays_at_once):
        part = slice(first, first + rays_at_once)
        start, direction = rays.starts[part], rays.directions[part]
        crossings = [np.zeros((len(start), 1)), np.ones((len(start), 1))]
        for axis, n in enumerate(shape):
            s, d = start[:, axis, None], direction[:, axis, None]
            parallel = d == 0
            # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
            alpha = np.clip((np.arange(n + 1) - s) / np.where(parallel, 1.0, d), 0.0, 1.0)
            crossings.append(np.where(parallel, 0.0, alpha))
        alpha = np.concatenate(crossings, axis=1)
        order = alpha.argsort(axis=1)
        alpha = np.take_along_axis(alpha, order, axis=1)
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2

        index = np.zeros(middle.shape, dtype=np.intp)
        inside = np.ones(middle.shape, dtype=bool)
        for axis, n in enumerate(shape):
            voxel = np.floor(start[:, axis, None] + middle * direction[:, axis, None])
            inside &= (voxel >= 0) & (voxel < n)
            index = index * n + np.clip(voxel, 0, n - 1).astype(np.intp)
        index[~inside] = 0
        yield part, index, inside, alpha, axes[order]
