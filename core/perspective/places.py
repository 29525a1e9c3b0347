"""Gathering of array values at the places of a lattice's points, under homogeneous transforms; scattering, the adjoint.

All resampling to and from perspective grids and all backprojections use these two, in C or else in numpy.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Floats
from ..progress import Progress, tell
from ..rays.parallel import in_order, thread_count

try:
    from ..rays.backends.cpu import gather as _gather_kernel
    from ..rays.backends.cpu import scatter as _scatter_kernel
except (ImportError, OSError):  # this platform has no kernels
    _gather_kernel = _scatter_kernel = None  # type: ignore[assignment]


SUM, LEAST, PRODUCT = 0, 1, 2
"""Ways of combining a point's value with the array values at its places."""

_SLABS = 4  # slabs of work per thread, so that no thread waits long for the others


def gather(
    points: Array,
    planes: Floats,
    arrays: Array,
    matrices: Floats,
    *,
    how: int = SUM,
    flat: bool = False,
    by_depth: bool = False,
    nearest: float = 0.0,
    seen: NDArray[np.int32] | None = None,
    exponents: NDArray[np.int32] | None = None,
    progress: Progress | None = None,
) -> None:
    """Combine each point's value, in place, with every array's value at the point's place, interpolated linearly.

    The place of point (i, j, k) in an array follows from the array's matrix: with ``p = matrix @ (i, j, planes[k], 1)`` it
    is at the array indices ``(p0 / p3, p1 / p3, p2 / p4)``. Up to half an element outside the array, its outermost elements
    are used. Farther out, or where p3 or p4 is not above 0, the array does not cover the point and leaves its value as it
    is.

    Parameters
    ----------
    points : array (n_x, n_y, n_z) of float32 or float64
        Values of the points, changed in place.
    planes : array (n_z,)
        Third coordinates of the points, ascending or descending.
    arrays : array (M, m_x, m_y, m_z) of the points' type
    matrices : array (M, 5, 4)
    how
        `SUM`, `LEAST`, or `PRODUCT`, the last of values of at least 0.
    flat
        Whether the arrays are single planes (m_z = 1) that cover all third coordinates.
    by_depth
        Whether array values are divided by p3^2.
    nearest
        Lower limit of p3: the array covers only points above it.
    seen : array of int32, of the points' shape
        Number of arrays that cover each point, added to in place.
    exponents : array of int32, of the points' shape
        Binary exponents of products, added to in place; `PRODUCT` needs them: the product is the point's value times 2 to
        this power.
    progress
        Called as ``progress(done, total)`` between slabs; an exception raised there stops the work.
    """
    n, workers = len(points), thread_count(None)
    size = max(1, -(-n // (_SLABS * workers)))
    kernel = _gather_in_numpy if _gather_kernel is None else _gather_kernel
    options: Any = {"flat": flat, "by_depth": by_depth, "nearest": nearest}

    def work(first: int) -> None:
        """Gather for the slab of points that starts at index `first`."""
        slab = slice(first, first + size)
        counters = [None if counter is None else counter[slab] for counter in (seen, exponents)]
        kernel(points[slab], planes, arrays, shifted(matrices, first), how, *counters, **options)

    _run_slabs(in_order(work, range(0, n, size), workers), size, n, progress)


def scatter(points: Array, planes: Floats, array: Array, matrix: Floats, progress: Progress | None = None) -> None:
    """Add the points' values, in place, to the elements of `array` around their places: the adjoint of `gather` with `SUM`.

    `points` is (n_x, n_y, n_z), `array` (m_x, m_y, m_z), `planes` and `matrix` (5, 4) are as for `gather`. Each thread has
    planes of the array to itself, so the result does not depend on the number of threads.
    """
    m, workers = len(array), thread_count(None)
    size = max(1, -(-m // (_SLABS * workers)))
    kernel = _scatter_in_numpy if _scatter_kernel is None else _scatter_kernel
    slabs = (slice(first, first + size) for first in range(0, m, size))
    _run_slabs(in_order(lambda slab: kernel(points, planes, array, matrix, slab), slabs, workers), size, m, progress)


def _run_slabs(slabs: Iterator[None], size: int, total: int, progress: Progress | None) -> None:
    """Run all slabs of work, of `size` planes each, and report the planes done of `total`."""
    for n_done, _ in enumerate(slabs, 1):
        tell(progress, min(n_done * size, total), total)


def shifted(matrices: Floats, first: int) -> Floats:
    """Return `matrices` for points whose first index starts at 0 instead of `first`."""
    result = matrices.copy()
    result[..., 3] += first * result[..., 0]
    return result


def _stencils(
    n: tuple[int, int], planes: Array, matrix: Array, m: tuple[int, ...], flat: bool, nearest: float
) -> tuple[Array, Array, Array, Array]:
    """Return for every point of a lattice its linear interpolation in an array: inside, lower corners, upper weights, p3.

    `inside` (n_x, n_y, n_z) is whether the array covers the point. The lower corners are the first of two array indices
    along each axis, (3, n_x, n_y, n_z), and the weights those of the second index, between 0 and 1. p3, (n_x, n_y, n_z), is
    the projective depth, 1 outside.
    """
    i, j = np.ogrid[: n[0], : n[1]]
    p = [row[0] * i[..., None] + row[1] * j[..., None] + row[2] * planes + row[3] for row in matrix]
    inside = (p[3] > nearest) & (flat | (p[4] > 0))
    depth = np.where(inside, p[3], 1.0)
    corners, weights = [], []
    for axis, divisor in enumerate((depth, depth, np.where(inside, p[4], 1.0))):
        index = np.zeros_like(depth) if flat and axis == 2 else p[axis] / divisor
        inside = inside & (index >= -0.5) & (index <= m[axis] - 0.5)
        index = np.where(inside, index, 0.0).clip(0, m[axis] - 1)  # NaN is not inside either
        corner = np.minimum(index, max(m[axis] - 2, 0)).astype(np.intp)
        corners.append(corner)
        weights.append(index - corner)
    return inside, np.stack(corners), np.stack(weights), depth


def _corners(corners: Array, weights: Array, shape: tuple[int, ...]) -> Any:
    """Yield the index arrays and the weight of each of the eight elements around the places.

    `corners` and `weights` are those of `_stencils`, `shape` is the array's.
    """
    for offsets in np.ndindex(2, 2, 2):
        weight = np.prod([w if upper else 1 - w for w, upper in zip(weights, offsets, strict=True)], axis=0)
        index = tuple(np.minimum(c + upper, n - 1) for c, upper, n in zip(corners, offsets, shape, strict=True))
        yield index, weight


def _gather_in_numpy(
    points: Array, planes: Array, arrays: Array, matrices: Floats, how: int, seen: Any, exponents: Any, **options: Any
) -> None:
    """Do the work of `gather` without the kernel."""
    flat, by_depth, nearest = options["flat"], options["by_depth"], options["nearest"]
    for array, matrix in zip(arrays, matrices, strict=True):
        for i in range(len(points)):  # one plane at a time needs little memory
            stencils = _stencils((1, points.shape[1]), planes, shifted(matrix, i), array.shape, flat, nearest)
            inside, corners, weights, depth = (values[..., 0, :, :] for values in stencils)
            with np.errstate(invalid="ignore"):  # infinity times a weight of 0
                value = sum(array[index] * weight for index, weight in _corners(corners, weights, array.shape))
            if by_depth:
                value = value / depth**2
            plane = points[i]
            if how == SUM:
                combined = plane + value
            elif how == LEAST:
                combined = np.minimum(plane, value)
            else:
                combined, exponent = np.frexp(plane * value)
                exponents[i] += inside * exponent
            plane[...] = np.where(inside, combined, plane)
            if seen is not None:
                seen[i] += inside


def _scatter_in_numpy(points: Array, planes: Array, array: Array, matrix: Floats, slab: slice) -> None:
    """Do the work of `scatter` without the kernel, for the planes `slab` of the array."""
    slab_array = array[slab]
    first = slab.indices(len(array))[0]
    for i in range(len(points)):
        stencils = _stencils((1, points.shape[1]), planes, shifted(matrix, i), array.shape, False, 0.0)
        inside, corners, weights, _ = (values[..., 0, :, :] for values in stencils)
        for index, weight in _corners(corners, weights, array.shape):
            in_slab = inside & (index[0] >= first) & (index[0] < first + len(slab_array))
            local = (index[0][in_slab] - first, index[1][in_slab], index[2][in_slab])
            np.add.at(slab_array, local, (points[i] * weight)[in_slab])
