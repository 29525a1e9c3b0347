"""Shares of photons that reach a pinhole from every voxel of a grid, for models without rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.grid import Grid
from ..geometry.views import Views
from ..volumes.volume import Volume
from .tracing import trace_rays

Array = NDArray[np.float32]

_NODES_APART = 3.0  # mm, at most


class Transmittances:
    """``exp(-integral of mu)`` from the middle of each voxel of `grid` to each view's source.

    The integrals are exact at nodes at most 3 mm apart, and interpolated between them: they change slowly.
    """

    def __init__(self, mu: Volume, grid: Grid, views: Views) -> None:
        self._mu, self._grid, self._views = mu, grid, views
        ticks = [
            np.linspace(0, n - 1, max(min(n, 2), int(np.ceil((n - 1) * size / _NODES_APART)) + 1))
            for n, size in zip(grid.shape, grid.spacing, strict=True)
        ]
        self._to_voxels = [_interpolation(n, at) for n, at in zip(grid.shape, ticks, strict=True)]
        self._ticks = ticks
        self._integrals: list[Array] | None = None

    def prepare(self) -> None:
        """Trace the rays to the nodes, with threads of their own, if that is not done yet."""
        if self._integrals is not None:
            return
        nodes = np.stack(np.meshgrid(*self._ticks, indexing="ij"), axis=-1)
        points = (nodes @ self._grid.affine[:3, :3].T + self._grid.affine[:3, 3]).reshape(-1, 3)
        self._integrals = [
            np.asarray(trace_rays(self._mu, source, points), np.float32).reshape(nodes.shape[:3])
            for source in self._views.sources
        ]

    def __getitem__(self, m: int) -> Array:
        """Of view m, of the grid's shape, once prepared."""
        integrals = self._integrals[m]  # type: ignore[index]
        for matrix in self._to_voxels:  # axis by axis: the first becomes the last
            integrals = np.tensordot(integrals, matrix, axes=(0, 1))
        return np.exp(-integrals)  # type: ignore[no-any-return]


def _interpolation(n: int, at: NDArray[np.float64]) -> Array:
    """Matrix (n, nodes) of linear interpolation from nodes at indices `at` to all n."""
    hats = [np.interp(np.arange(n), at, one) for one in np.eye(len(at))]
    return np.stack(hats, axis=1).astype(np.float32)
