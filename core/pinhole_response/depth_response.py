"""Projections without rays: voxels are shared out among the cells of fine images in planes of depth, and back.

What the numbers of a view are comes from `hole_response`; the work is done by functions of a backend.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array

Index = tuple[int, ...]


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
    padded: Array
    """The kernel between rows of zeros, as many as a pixel's rows of cells: the backend cpu reads on into them."""
    steps: tuple[int, int]
    """Rows and columns of cells from a pixel to the next."""
    after: Array
    """(n_v, n_u): factors of the pixels."""
    places: tuple[Array, Array] | None = None
    """Where the pixels' rows (n_v,) and columns (n_u,) lie on a lattice of nodes, in steps of it.

    Then `padded` has two axes more after the planes', those of the nodes, and a pixel's kernel is mixed linearly from those
    of the four nodes around it."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Planes of depth, and rows and columns of cells in each."""
        return len(self.padded), *self.before.shape  # type: ignore[return-value]

    @property
    def kernel(self) -> Array:
        """(planes, [nodes,] taps, taps): what a pixel counts of the cells from its first on."""
        return self.padded[..., self.steps[0] : -self.steps[0], :]

    @functools.cached_property
    def bounds(self) -> NDArray[np.int64]:
        """(planes, [nodes,] padded rows, 2): where in each row of the kernel taps begin that are not 0, and where they end.

        A node's are those of the next one along v, too.
        """
        has = self.padded != 0
        if self.places is not None:
            has[:, :-1] |= has[:, 1:]
        return np.stack([has.argmax(-1), has.shape[-1] - has[..., ::-1].argmax(-1)], -1) * has.any(-1, keepdims=True)

    def of_nodes(self) -> Iterator[tuple[Index, DepthResponse, tuple[slice, slice], tuple[slice, slice]]]:
        """Node by node the response of pixels around it by its kernel alone, times its weights; and their part of all.

        Given are the node's number along v and u, and the pixels' and the cells' rows and columns.
        """
        assert self.places is not None
        for node in np.ndindex(self.padded.shape[1:3]):
            shares = [np.maximum(1 - np.abs(at - k), 0) for at, k in zip(self.places, node, strict=True)]
            if not (shares[0].any() and shares[1].any()):
                continue
            pixels, cells = [], []
            for own, step, size in zip(shares, self.steps, self.before.shape, strict=True):
                used = np.flatnonzero(own)
                pixels.append(slice(int(used[0]), int(used[-1]) + 1))
                cells.append(self._cells(pixels[-1], step, len(own), size))
            rows, columns = pixels
            after = self.after[rows, columns] * np.outer(shares[0][rows], shares[1][columns])
            before, padded = np.ascontiguousarray(self.before[tuple(cells)]), self.padded[:, node[0], node[1]]
            of = replace(self, before=before, padded=np.ascontiguousarray(padded), after=after, places=None)
            yield node, of, (rows, columns), (cells[0], cells[1])

    @staticmethod
    def _cells(pixels: slice, step: int, n: int, size: int) -> slice:
        """Cells, of `size` along an axis, that some of n pixels sum."""
        return slice(step * pixels.start, step * pixels.stop + size - step * n)

    def of_part(self, origin: Index, shape: Index) -> tuple[DepthResponse, tuple[slice, slice]]:
        """The response to a part of the volume alone, and the rows and columns of pixels that may see it."""
        matrix = self.matrix.copy()
        matrix[:, 3] += matrix[:, :3] @ origin
        corners = np.array(list(itertools.product(*((-0.5, n - 0.5) for n in shape), (1,))))
        column, row, depth = matrix @ corners.T
        if depth.min() <= self.nearest / 2:  # seen from among the voxels, they may be anywhere
            return replace(self, matrix=matrix), (slice(None), slice(None))
        pixels, cells = [], []
        sizes = self.kernel.shape[-2:], self.steps, self.after.shape, self.before.shape
        for at, taps, step, n, size in zip((row, column), *sizes, strict=True):
            low, high = float((at / depth).min()) - 2, float((at / depth).max()) + 2
            start = min(max(math.floor((low - taps) / step) + 1, 0), n - 1)
            stop = max(start, min(math.floor(high / step), n - 1)) + 1
            pixels.append(slice(start, stop))
            cells.append(self._cells(pixels[-1], step, n, size))
        planes = (1 / depth - self.first_plane) * self.planes_per_inverse
        nearer = min(max(math.ceil(planes.max()), 1), len(self.padded) - 1)
        farther = min(max(math.floor(planes.min()), 0), nearer - 1)
        matrix[0] -= cells[1].start * matrix[2]
        matrix[1] -= cells[0].start * matrix[2]
        before, after = self.before[tuple(cells)], self.after[tuple(pixels)]
        first, padded = self.first_plane + farther / self.planes_per_inverse, self.padded[farther : nearer + 1]
        places = None if self.places is None else (self.places[0][pixels[0]], self.places[1][pixels[1]])
        part = replace(self, matrix=matrix, first_plane=first, before=before, padded=padded, after=after, places=places)
        return part, (pixels[0], pixels[1])
