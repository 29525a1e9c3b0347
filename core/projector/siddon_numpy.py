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


def _segments(shape: tuple[int, ...], rays: IndexRays) -> Iterator[tuple[slice, NDArray[np.intp], Array]]:
    """Segments of the rays, some rays at a time: which rays (a slice), flat voxel index (n, S), length in mm (n, S).

    A segment outside the volume has length 0 and index 0.
    """
    rays_at_once = max(1, _CROSSINGS // (sum(shape) + 5))
    for first in range(0, len(rays), rays_at_once):
        part = slice(first, first + rays_at_once)
        start, direction, length = rays.starts[part], rays.directions[part], rays.lengths[part]
        crossings = [np.zeros((len(start), 1)), np.ones((len(start), 1))]
        for axis, n in enumerate(shape):
            s, d = start[:, axis, None], direction[:, axis, None]
            parallel = d == 0
            # Crossings before the source or behind the target become segments of length 0 at the ray's ends.
            alpha = np.clip((np.arange(n + 1) - s) / np.where(parallel, 1.0, d), 0.0, 1.0)
            crossings.append(np.where(parallel, 0.0, alpha))
        alpha = np.sort(np.concatenate(crossings, axis=1), axis=1)
        middle = (alpha[:, 1:] + alpha[:, :-1]) / 2

        index = np.zeros(middle.shape, dtype=np.intp)
        inside = np.ones(middle.shape, dtype=bool)
        for axis, n in enumerate(shape):
            voxel = np.floor(start[:, axis, None] + middle * direction[:, axis, None])
            inside &= (voxel >= 0) & (voxel < n)
            index = index * n + np.clip(voxel, 0, n - 1).astype(np.intp)
        index[~inside] = 0
        yield part, index, np.where(inside, np.diff(alpha, axis=1) * length[:, None], 0.0)
