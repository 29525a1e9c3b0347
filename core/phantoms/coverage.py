"""How much of each voxel a shape covers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..grid import Grid
from ..memory import require
from ..progress import Progress, in_threads

Distance = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Points (3, N), mm, in the shape's frame to signed distances (N,), mm: negative inside, and nowhere larger in
magnitude than the true distance (outside) or than the depth (inside)."""

# Points of one call of `Distance`: small enough that its temporaries stay in the processor's cache.
_BLOCK = 1 << 15
_MIN_SAMPLES, _MAX_SAMPLES = 128, 1024
# Few, large voxels can have more samples than that: up to so many altogether.
_SAMPLES_OF_COARSE_GRIDS = 1 << 22


def voxelize_shape(
    grid: Grid,
    pose: NDArray[np.float64],
    distance: Distance,
    low: ArrayLike,
    high: ArrayLike,
    finest: float,
    progress: Progress | None = None,
) -> NDArray[np.float32]:
    """Share of each voxel that lies inside a shape, 0 to 1, float32 array of the grid's shape.

    Voxels farther from the surface than their own half diagonal are all in or all out; the others are sampled at the
    points of a low-discrepancy sequence (M. Roberts' R3, a Kronecker sequence of the generalised golden ratio).

    Parameters
    ----------
    grid
        Where the voxels are.
    pose
        World-from-shape (4, 4), mm.
    distance
        The shape.
    low, high
        Corners (3,), mm, of a box around the shape, in its frame.
    finest
        Size, mm, of the shape's smallest part: larger voxels get more samples.
    progress
        Called as ``progress(done, total)`` with slabs of the grid.
    """
    require(4.2 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    coverage = np.zeros(grid.shape, np.float32)
    shape_from_index = np.linalg.inv(pose) @ grid.affine
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    start, stop = _index_box(shape_from_index, low, high, grid.shape)
    linear = shape_from_index[:3, :3]
    edges = np.linalg.norm(linear, axis=0)
    # The voxel's farthest corner from its centre, over the four diagonals of a parallelepiped.
    signs = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]])
    half_diagonal = np.float32(0.5 * np.linalg.norm(signs @ linear.T, axis=1).max() * (1 + 1e-5))
    most = max(_MAX_SAMPLES, _SAMPLES_OF_COARSE_GRIDS // max(1, int(np.prod(stop - start))))
    n_samples = int(np.clip(_MIN_SAMPLES * (edges.max() / (0.5 * finest)) ** 3, _MIN_SAMPLES, most))
    samples = (linear @ (_r3_sequence(n_samples) - 0.5)).astype(np.float32)

    iy, iz = np.meshgrid(np.arange(start[1], stop[1]), np.arange(start[2], stop[2]), indexing="ij")
    in_slab = linear[:, 1:] @ np.stack([iy.ravel(), iz.ravel()])

    def fill(ix: int) -> None:
        centers = (in_slab + (linear[:, 0] * ix + shape_from_index[:3, 3])[:, None]).astype(np.float32)
        slab = np.empty(centers.shape[1], np.float32)
        for first in range(0, len(slab), _BLOCK):
            block = slice(first, first + _BLOCK)
            slab[block] = _coverage(centers[:, block], distance, half_diagonal, samples)
        coverage[ix, start[1] : stop[1], start[2] : stop[2]] = slab.reshape(iy.shape)

    in_threads(fill, range(start[0], stop[0]), progress)
    return coverage


def _coverage(
    centers: NDArray[np.float32], distance: Distance, half_diagonal: np.float32, samples: NDArray[np.float32]
) -> NDArray[np.float32]:
    from_surface = distance(centers)
    covered = (from_surface < 0).astype(np.float32)
    cut = np.flatnonzero(np.abs(from_surface) < half_diagonal)
    n_samples = samples.shape[1]
    step = max(1, _BLOCK // n_samples)
    for first in range(0, len(cut), step):
        some = cut[first : first + step]
        points = (centers[:, some, None] + samples[:, None, :]).reshape(3, -1)
        covered[some] = (distance(points) < 0).reshape(len(some), n_samples).mean(axis=1)
    return covered


def _index_box(
    shape_from_index: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and one-past-last indices (3,) of the voxels that may touch the box from `low` to `high`."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    index_from_shape = np.linalg.inv(shape_from_index)
    index = corners @ index_from_shape[:3, :3].T + index_from_shape[:3, 3]
    # Clipped as floats: a far-away box must not overflow the integers.
    start = np.clip(np.floor(index.min(axis=0) - 0.5), 0, shape).astype(np.int64)
    stop = np.clip(np.ceil(index.max(axis=0) + 0.5) + 1, 0, shape).astype(np.int64)
    return start, np.maximum(start, stop)


def _r3_sequence(n: int) -> NDArray[np.float64]:
    """`n` points of the unit cube, (3, n)."""
    ratio = 1.2207440846057596  # the real root of x^4 = x + 1
    steps = ratio ** -np.arange(1.0, 4.0)
    return (0.5 + np.outer(steps, np.arange(1, n + 1))) % 1.0
