"""The response of one view to the voxels of one depth zone, as numbers that the work is done with.

`zone_response` makes the numbers; `compiled` and `reference` project and back-project with them.
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
"""Index of a voxel or shape of a box (x, y, z), or number of a node (v, u)."""
Block = tuple[slice, slice]
"""Rows and columns of pixels or cells."""


@dataclass(frozen=True, eq=False)
class DepthResponse:
    """Places of the voxels of a depth zone in a fine image, and the kernels with which pixels sum the cells of that image.

    The image has planes of depth, evenly spaced in 1 / h; docs/pinhole-response.md derives it.
    """

    matrix: Array
    """(3, 4), from a voxel's index (x, y, z, 1) to (column h, row h, h): cell column, cell row and depth h, mm."""
    piece_offsets: Array
    """(n, 3), centres of the pieces of a voxel relative to its own centre, as indices."""
    depth_line: Array
    """(3,), vector from end to end of the line that stands for the depth of a piece, as indices."""
    max_point_length: float
    """Length, cells, up to which the line of a piece is sampled by one point."""
    max_pair_length: float
    """Length, cells, up to which the line of a piece is sampled by two points on the same 3 x 3 cells."""
    samples_per_cell: float
    """Number of points per cell of a longer line, besides two; the product with the length is rounded down."""
    nearest: float
    """Depth, mm, at or below which a voxel has no weight."""
    farthest: float
    """Depth, mm, above which a voxel has no weight."""
    first_plane: float
    """Inverse depth 1 / h of the farthest plane, 1/mm."""
    planes_per_inverse_depth: float
    """Number of planes per 1/mm of inverse depth."""
    cell_weights: Array
    """(rows, columns), expected counts of a piece of value 1 at a cell, times h^2, without `pixel_weights`."""
    padded_kernels: Array
    """`kernels` between rows of zeros, as many as a pixel has rows of cells: the compiled code reads these, too."""
    cells_per_pixel: tuple[int, int]
    """Rows and columns of cells from a pixel to the next."""
    pixel_weights: Array
    """(n_v, n_u), factors of the pixels."""
    node_positions: tuple[Array, Array] | None = None
    """Positions of the pixels' rows (n_v,) and columns (n_u,) in a lattice of nodes, in steps of that lattice.

    With nodes, `padded_kernels` has two axes more after that of the planes, and the kernel of a pixel is mixed linearly from
    those of the four nodes around it. None where all pixels have the same kernel."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of planes, and rows and columns of cells in each."""
        return len(self.padded_kernels), *self.cell_weights.shape  # type: ignore[return-value]

    @property
    def kernels(self) -> Array:
        """(planes, [nodes along v, along u,] taps, taps), weights in a pixel of the cells from its first one on."""
        return self.padded_kernels[..., self.cells_per_pixel[0] : -self.cells_per_pixel[0], :]

    @functools.cached_property
    def tap_bounds(self) -> NDArray[np.int64]:
        """(planes, [nodes,] padded rows, 2), the first tap that is not 0 in each row of a kernel, and the end of such taps.

        The bounds of a node include those of the next node along v.
        """
        used = self.padded_kernels != 0
        if self.node_positions is not None:
            used[:, :-1] |= used[:, 1:]
        bounds = np.stack([used.argmax(-1), used.shape[-1] - used[..., ::-1].argmax(-1)], -1)
        return bounds * used.any(-1, keepdims=True)

    def node_responses(self) -> Iterator[tuple[Index, DepthResponse, Block, Block]]:
        """Yield each node's number along v and u, the response by its kernel alone, and the pixels and cells concerned.

        The response has the pixels between the node and its neighbours, times the node's share in them. Pixels and cells are
        slices of rows and columns.
        """
        assert self.node_positions is not None
        for node in np.ndindex(self.padded_kernels.shape[1:3]):
            shares = [np.maximum(1 - np.abs(row - k), 0) for row, k in zip(self.node_positions, node, strict=True)]
            if not (shares[0].any() and shares[1].any()):
                continue
            pixels, cells = [], []
            for share, step, size in zip(shares, self.cells_per_pixel, self.cell_weights.shape, strict=True):
                used = np.flatnonzero(share)
                pixels.append(slice(int(used[0]), int(used[-1]) + 1))
                cells.append(self._cells(pixels[-1], step, len(share), size))
            rows, columns = pixels
            kernels = np.ascontiguousarray(self.padded_kernels[:, node[0], node[1]])
            weights = self.pixel_weights[rows, columns] * np.outer(shares[0][rows], shares[1][columns])
            response = replace(self, padded_kernels=kernels, pixel_weights=weights, node_positions=None)
            response = replace(response, cell_weights=np.ascontiguousarray(self.cell_weights[tuple(cells)]))
            yield node, response, (rows, columns), (cells[0], cells[1])

    @staticmethod
    def _cells(pixels: slice, step: int, n: int, size: int) -> slice:
        """Return the cells, of `size` along an axis, that some of its n pixels sum."""
        return slice(step * pixels.start, step * pixels.stop + size - step * n)

    def restrict_to_box(self, origin: Index, shape: Index) -> tuple[DepthResponse, Block]:
        """Return the response to a box of the volume alone, and the rows and columns of pixels that may see it."""
        matrix = self.matrix.copy()
        matrix[:, 3] += matrix[:, :3] @ origin
        corners = np.array(list(itertools.product(*((-0.5, n - 0.5) for n in shape), (1,))))
        column, row, depth = matrix @ corners.T
        if depth.min() <= self.nearest / 2:  # the pinhole is among the voxels, which may be seen anywhere
            return replace(self, matrix=matrix), (slice(None), slice(None))
        pixels, cells = [], []
        sizes = self.kernels.shape[-2:], self.cells_per_pixel, self.pixel_weights.shape, self.cell_weights.shape
        for position, taps, step, n, size in zip((row, column), *sizes, strict=True):
            low, high = float((position / depth).min()) - 2, float((position / depth).max()) + 2
            start = min(max(math.floor((low - taps) / step) + 1, 0), n - 1)
            stop = max(start, min(math.floor(high / step), n - 1)) + 1
            pixels.append(slice(start, stop))
            cells.append(self._cells(pixels[-1], step, n, size))
        planes = (1 / depth - self.first_plane) * self.planes_per_inverse_depth
        nearer = min(max(math.ceil(planes.max()), 1), len(self.padded_kernels) - 1)
        farther = min(max(math.floor(planes.min()), 0), nearer - 1)
        matrix[0] -= cells[1].start * matrix[2]
        matrix[1] -= cells[0].start * matrix[2]
        positions = self.node_positions
        response = replace(self, matrix=matrix, first_plane=self.first_plane + farther / self.planes_per_inverse_depth,
                           cell_weights=self.cell_weights[tuple(cells)],
                           padded_kernels=self.padded_kernels[farther : nearer + 1],
                           pixel_weights=self.pixel_weights[tuple(pixels)],
                           node_positions=positions and (positions[0][pixels[0]], positions[1][pixels[1]]))  # fmt: skip
        return response, (pixels[0], pixels[1])
