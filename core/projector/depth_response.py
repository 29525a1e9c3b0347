"""Projections without rays: voxels are shared out among the cells of fine images in planes of depth, and back.

What the numbers of a view are comes from `hole_response`; the work is done by functions of a backend.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .parallel import in_order, run_all
from .transmittance import Transmittances

Array = NDArray[Any]

PLANES = 4
"""Planes of depth, evenly spaced in 1 / h: between two, an image is interpolated."""

TAPS_TOGETHER = 4
"""A row of a kernel is a multiple of so many taps."""

# Layers of voxels that a thread adds to before it takes others, and views whose cells are in memory.
_SLAB, _VIEWS_AT_ONCE = 4, 16


@dataclass(frozen=True, eq=False)
class DepthResponse:
    """One view: where its voxels lie in the fine image, and what its pixels count of the cells there."""

    matrix: Array
    """(3, 4): of a voxel's indices (x, y, z, 1), to (column h, row h, h)."""
    nearest: float
    """Depth, mm, up to which voxels count nothing."""
    first_plane: float
    """1 / h of the farthest plane, 1/mm."""
    planes_per_inverse: float
    """Planes in 1 / mm of 1 / h."""
    cells: tuple[int, int]
    """Rows and columns of the fine image."""
    before: Array
    """(rows, columns): what a voxel counts there in all, times h^2, and without `after`."""
    kernel: Array
    """(taps, taps, PLANES): what a pixel counts of the cells around it."""
    steps: tuple[int, int]
    """Rows and columns of cells from a pixel to the next."""
    after: Array
    """(n_v, n_u): factors of the pixels."""


class DepthResponses:
    """`n` views of volumes of a shape, each with its response, made when first needed by ``make(m)``.

    `transmittances` are what attenuation leaves, if anything attenuates.
    """

    def __init__(
        self,
        n: int,
        shape: tuple[int, int, int],
        make: Callable[[int], DepthResponse],
        transmittances: Transmittances | None = None,
    ) -> None:
        self._n, self._shape, self._make, self._transmittances = n, shape, make, transmittances
        self._made: dict[int, DepthResponse] = {}

    def __getitem__(self, m: int) -> DepthResponse:
        if m not in self._made:
            self._made[m] = self._make(m)
        return self._made[m]

    def _passes(self, m: int, like: Array) -> Array | None:
        return (
            None if self._transmittances is None else self._transmittances[m].astype(like.dtype, order="C", copy=False)
        )

    def _prepare(self) -> None:
        """What is not to be done within threads."""
        if self._transmittances is not None:
            self._transmittances.prepare()

    def images(self, volume: Array, functions: ModuleType, workers: int) -> Iterator[Array]:
        """The images of `volume` one by one."""
        self._prepare()

        def image(m: int) -> Array:
            of = self[m]
            cells = functions.voxels_to_cells(volume, of, self._passes(m, volume))
            cells *= of.before.astype(cells.dtype)[..., None]
            return functions.cells_to_pixels(cells, of) * of.after.astype(cells.dtype)  # type: ignore[no-any-return]

        return in_order(image, range(self._n), workers)

    def backproject(self, images: Array, functions: ModuleType, workers: int, report: Callable[[int], None]) -> Array:
        """The adjoint. Each thread has a slab of the volume, so the result does not depend on their number."""
        self._prepare()
        volume = np.zeros(self._shape, images.dtype)
        n, n_x = len(images), len(volume)
        slabs = [slice(x, min(x + _SLAB, n_x)) for x in range(0, n_x, _SLAB)]

        def cells_of(m: int) -> Array:
            of = self[m]
            cells = functions.pixels_to_cells(images[m] * of.after.astype(images.dtype), of)
            cells *= of.before.astype(cells.dtype)[..., None]
            return cells  # type: ignore[no-any-return]

        for first in range(0, n, _VIEWS_AT_ONCE):
            views = range(first, min(first + _VIEWS_AT_ONCE, n))
            cells = list(in_order(lambda m: (cells_of(m), self._passes(m, volume)), views, workers))

            def add(slab: slice, views: range = views, cells: list[Any] = cells) -> None:
                for m, (own, passes) in zip(views, cells, strict=True):
                    functions.cells_to_voxels(volume, own, self[m], passes, slab)

            run_all(add, slabs, workers)
            report(views.stop)
        return volume
