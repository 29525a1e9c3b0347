"""Voxel-driven backprojection: what filtered backprojections add up, from any views with projection matrices."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.grid import Grid
from ..projector.parallel import run_all, thread_count

try:
    from ..projector.backends.cpu import smear as _kernel
except (ImportError, OSError):  # no kernels for this platform
    _kernel = None  # type: ignore[assignment]

Array = NDArray[np.floating[Any]]

MARGIN = (1, 2)
"""Zeros before and after an image's rows and columns: beyond its edge an image falls to 0 over one pixel."""

_BEHIND = 1e-3  # of the distance from source to detector: nearer to the source, nothing is taken


def with_margin(shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """Images of zeros with margins, and a view of what is inside the margins, of this shape."""
    n, rows, columns = shape
    images = np.zeros((n, rows + sum(MARGIN), columns + sum(MARGIN)), np.float32)
    return images, images[:, MARGIN[0] : -MARGIN[1], MARGIN[0] : -MARGIN[1]]


def backproject(volume: Array, grid: Grid, images: Array, matrices: Array) -> None:
    """Add to every voxel what each image has at its place, interpolated linearly, divided by the square of its depth.

    Parameters
    ----------
    volume : array of float32, ``grid.shape``
    images : array of float32 (M, rows, columns)
        With margins, as of `with_margin`.
    matrices : array (M, 3, 4)
        From world points to columns, rows (0: the first inside the margin) and depths, as of `Views.projection_matrices`.
    """
    shift = np.array([[1.0, 0.0, MARGIN[0]], [0.0, 1.0, MARGIN[0]], [0.0, 0.0, 1.0]])
    from_index = shift @ matrices @ grid.affine
    n, workers = len(volume), thread_count(None)
    size = max(1, -(-n // (4 * workers)))

    def add(first: int) -> None:
        moved = from_index.copy()
        moved[:, :, 3] += first * moved[:, :, 0]
        (_numpy if _kernel is None else _kernel)(volume[first : first + size], images, moved)

    run_all(add, range(0, n, size), workers)


def _numpy(volume: Array, images: Array, matrices: Array) -> None:
    """The kernel in numpy, plane by plane."""
    _, rows, columns = images.shape
    y, z = np.meshgrid(*map(np.arange, volume.shape[1:]), indexing="ij")
    for image, matrix in zip(images, matrices, strict=True):
        for x, plane in enumerate(volume):
            column, row, depth = (p[0] * x + p[1] * y + p[2] * z + p[3] for p in matrix)
            front = depth > _BEHIND
            depth = np.where(front, depth, 1.0)
            column, row = np.clip(column / depth, 0, columns - 2), np.clip(row / depth, 0, rows - 2)
            i, j = row.astype(np.intp), column.astype(np.intp)
            down, right = row - i, column - j
            upper = (1 - right) * image[i, j] + right * image[i, j + 1]
            lower = (1 - right) * image[i + 1, j] + right * image[i + 1, j + 1]
            plane += front * ((1 - down) * upper + down * lower) / depth**2
