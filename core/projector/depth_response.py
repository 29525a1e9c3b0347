"""Projections without rays: voxels are shared out among the cells of fine images in planes of depth, and back.

What the numbers of a view are comes from `hole_response`; the work is done by functions of a backend.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import cropped
from ..geometry.grid import Grid
from ..volumes.volume import Volume
from .parallel import in_order, run_all

Array = NDArray[Any]
Index = tuple[int, ...]
VoxelBox = tuple[tuple[slice, ...], NDArray[np.bool_]]
"""A box of a grid, and which of its voxels."""

# Layers of voxels that a thread adds to before it takes others, and bytes of the views' cells that are in memory.
_SLAB, _CELLS_AT_ONCE = 4, 2**28
# Bytes of transmittances that are kept from call to call.
_KEPT = 2**30


@dataclass(frozen=True, eq=False)
class DepthResponse:
    """A view's voxels in a zone of depth: where they lie in a fine image, and what pixels count of the cells there."""

    matrix: Array
    """(3, 4): of a voxel's indices (x, y, z, 1), to (column h, row h, h)."""
    pieces: Array
    """(n, 3): from a voxel's middle to those of its pieces, as indices; each is shared out by itself,"""
    line: Array
    """(3,): from end to end, as indices, of the line that a piece is by its depth."""
    of_point: float
    """Columns or rows of cells that a line covers up to which it is taken as a point,"""
    of_pair: float
    """and as two that share their cells. A longer one is taken as two points"""
    parts_per_cell: float
    """and so many more for each cell that it covers, in whole numbers."""
    nearest: float
    """Depth, mm, up to which voxels count nothing,"""
    farthest: float
    """and beyond which they count nothing."""
    first_plane: float
    """1 / h of the farthest plane, 1/mm."""
    planes_per_inverse: float
    """Planes in 1 / mm of 1 / h."""
    before: Array
    """(rows, columns): what a part counts at a cell of the fine image in all, times h^2, and without `after`."""
    kernel: Array
    """(planes, taps, taps): what a pixel counts of the cells from its first on."""
    steps: tuple[int, int]
    """Rows and columns of cells from a pixel to the next."""
    after: Array
    """(n_v, n_u): factors of the pixels."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Planes of depth, and rows and columns of cells in each."""
        return len(self.kernel), *self.before.shape  # type: ignore[return-value]

    def of_part(self, origin: Index, shape: Index) -> tuple[DepthResponse, tuple[slice, slice]]:
        """The response to a part of the volume alone, and the rows and columns of pixels that may see it."""
        matrix = self.matrix.copy()
        matrix[:, 3] += matrix[:, :3] @ origin
        corners = np.array(list(itertools.product(*((-0.5, n - 0.5) for n in shape), (1,))))
        column, row, depth = matrix @ corners.T
        if depth.min() <= self.nearest / 2:  # seen from among the voxels, they may be anywhere
            return replace(self, matrix=matrix), (slice(None), slice(None))
        pixels, cells = [], []
        for at, taps, step, n, size in zip(
            (row, column), self.kernel.shape[1:], self.steps, self.after.shape, self.before.shape, strict=True
        ):
            low, high = float((at / depth).min()) - 2, float((at / depth).max()) + 2
            start = min(max(math.floor((low - taps) / step) + 1, 0), n - 1)
            stop = max(start, min(math.floor(high / step), n - 1)) + 1
            pixels.append(slice(start, stop))
            cells.append(slice(step * start, step * stop + size - step * n))
        planes = (1 / depth - self.first_plane) * self.planes_per_inverse
        nearer = min(max(math.ceil(planes.max()), 1), len(self.kernel) - 1)
        farther = min(max(math.floor(planes.min()), 0), nearer - 1)
        matrix[0] -= cells[1].start * matrix[2]
        matrix[1] -= cells[0].start * matrix[2]
        return replace(
            self,
            matrix=matrix,
            first_plane=self.first_plane + farther / self.planes_per_inverse,
            before=self.before[tuple(cells)],
            kernel=self.kernel[farther : nearer + 1],
            after=self.after[tuple(pixels)],
        ), (pixels[0], pixels[1])


class DepthResponses(ABC):
    """`n` views of `pixels` (n_v, n_u) of volumes on a grid, attenuated by `mu`, if any.

    Each view has a response for every zone of depth, made when first needed.
    """

    def __init__(self, n: int, pixels: tuple[int, int], grid: Grid, mu: Volume | None) -> None:
        self.n, self.pixels, self.grid, self.mu = n, pixels, grid, mu
        self._made: dict[tuple[int, float], DepthResponse] = {}
        self._zones: dict[int, list[tuple[float, float]]] = {}
        self._passing: dict[int, tuple[Index, Array]] = {}
        self._room = _KEPT

    @abstractmethod
    def make(self, m: int, far: float, near: float) -> DepthResponse:
        """View m's response to voxels in a zone from far to near, mm."""

    @abstractmethod
    def depths(self, m: int) -> Array:
        """The row (4,) that gives the depth of a voxel (x, y, z, 1) before view m's pinhole, mm."""

    @abstractmethod
    def zones(self, m: int) -> list[tuple[float, float]]:
        """Of view m the zones of depth, each from far to near, mm."""

    @abstractmethod
    def close(self, m: int) -> VoxelBox | None:
        """Voxels before view m's pinhole that are nearer than all zones; None where it may see none."""

    @abstractmethod
    def transmittance(self, m: int, mu: Volume, part: Grid) -> Array:
        """What `mu` leaves of the photons from each voxel of a part of the grid, on their way to view m's pinhole."""

    def images(self, volume: Array, functions: ModuleType, workers: int, mu: Volume | None = None) -> Iterator[Array]:
        """The images of `volume` one by one; `mu` may attenuate in place of the usual."""
        (filled,), origin = cropped(volume)
        filled = np.ascontiguousarray(filled)

        def image(m: int) -> Array:
            image, parts = np.zeros(self.pixels, volume.dtype), self._of_part(m, origin, filled.shape)
            passes = self._passes(m, origin, filled, mu) if parts else None
            for of, pixels in parts:
                cells = functions.voxels_to_cells(filled, of, passes)
                image[pixels] += functions.cells_to_pixels(cells, of)
            return image

        return in_order(image, range(self.n), workers)

    def backproject(
        self,
        images: Array,
        functions: ModuleType,
        workers: int,
        report: Callable[[int], None],
        mu: Volume | None = None,
    ) -> Array:
        """The adjoint. Each thread has a slab of the volume, so the result does not depend on their number."""
        volume = np.zeros(self.grid.shape, images.dtype)
        slabs = [slice(x, x + _SLAB) for x in range(0, len(volume), _SLAB)]
        whole = (0, 0, 0), self.grid.shape

        def give(m: int) -> tuple[Array | None, list[tuple[DepthResponse, Array]]]:
            given = [(of, functions.pixels_to_cells(images[m][pixels], of)) for of, pixels in self._of_part(m, *whole)]
            return self._passes(m, whole[0], volume, mu) if given else None, given

        n, first = len(images), 0
        while first < n:
            size = sum(4 * math.prod(of.shape) for of, _ in self._of_part(first, *whole))
            last = min(first + max(workers, _CELLS_AT_ONCE // max(size, 1)), n)
            given = list(in_order(give, range(first, last), workers))

            def take(slab: slice, given: list[Any] = given) -> None:
                for passes, cells in given:
                    for of, own in cells:
                        functions.cells_to_voxels(volume, own, of, passes, slab)

            run_all(take, slabs, workers)
            first = last
            report(first)
        return volume

    def _of_part(self, m: int, origin: Index, shape: Index) -> list[tuple[DepthResponse, tuple[slice, slice]]]:
        """View m's responses to a part of the volume, of the zones that it reaches into, and the pixels that may see it."""
        row = self.depths(m)
        if m not in self._zones:
            self._zones[m] = self.zones(m)
        depths = [row @ (*np.add(origin, corner), 1) for corner in itertools.product(*((0, n - 1) for n in shape))]
        reached = [(far, near) for far, near in self._zones[m] if max(depths) > near and min(depths) <= far]
        return [self._response(m, far, near).of_part(origin, shape) for far, near in reached]

    def _response(self, m: int, far: float, near: float) -> DepthResponse:
        if (m, far) not in self._made:
            self._made[m, far] = self.make(m, far, near)
        return self._made[m, far]

    def _passes(self, m: int, origin: Index, part: Array, mu: Volume | None) -> Array | None:
        """What attenuation leaves of the photons from each voxel of a part of the volume."""
        if mu is None and self.mu is None:
            return None
        grid = self.grid.box(origin, part.shape)
        if mu is not None:
            return self.transmittance(m, mu, grid).astype(part.dtype, copy=False)
        start, kept = self._passing.get(m, (origin, None))
        first = np.subtract(origin, start)
        if kept is None or first.min() < 0 or (first + part.shape > kept.shape).any():
            self._room += self._passing.pop(m)[1].nbytes if m in self._passing else 0
            first, kept = np.zeros(3, int), self.transmittance(m, self.mu, grid)  # type: ignore[arg-type]
            if kept.nbytes <= self._room:
                self._room -= kept.nbytes
                self._passing[m] = origin, kept
        inside = tuple(slice(a, a + n) for a, n in zip(first.tolist(), part.shape, strict=True))
        return np.ascontiguousarray(kept[inside], part.dtype)
