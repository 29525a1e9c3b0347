"""Gathering: numbers of arrays at the places of a lattice's points, under homogeneous transforms; scattering: the adjoint.

All resampling to and from perspective grids, and all backprojections, are this; in C, or else in numpy.
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
except (ImportError, OSError):  # no kernels for this platform
    _gather_kernel = _scatter_kernel = None  # type: ignore[assignment]


SUM, LEAST, PRODUCT = 0, 1, 2
"""In which way a point's number is combined with those at its places."""

_SLABS = 4  # of points or of an array's planes, for each thread: none waits long for the others


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
    """Combine each point's number with what every array has at its place, interpolated linearly.

    The place of point (i, j, k) in an array is given by its matrix: with ``p = matrix @ (i, j, planes[k], 1)`` it is at the
    indices ``(p0 / p3, p1 / p3, p2 / p4)``. Up to half an element outside, the outermost elements count; farther out, or
    where p3 or p4 is not above 0, the array does not have the point, and the point's number stays.

    Parameters
    ----------
    points : array (n_x, n_y, n_z) of float32 or float64
        Changed in place.
    planes : array (n_z,)
        Third coordinates of the points, ascending or descending.
    arrays : array (M, m_x, m_y, m_z) of the points' type
    matrices : array (M, 5, 4)
    how
        `SUM`, `LEAST`, or `PRODUCT`, of numbers of at least 0.
    flat
        The arrays are one plane each (m_z = 1), and all third coordinates lie in it.
    by_depth
        Divide what is taken by p3^2.
    nearest
        What p3 must be above.
    seen : array of int32, of the points' shape
        Counted up by 1 for every array that has the point.
    exponents : array of int32, of the points' shape
        Needed by `PRODUCT`, and counted up: a product is the point's number times 2 to this power.
    progress
        Called as ``progress(done, total)`` between parts; what it raises stops the work.
    """
    n, workers = len(points), thread_count(None)
    size = max(1, -(-n // (_SLABS * workers)))
    kernel = _gather_in_numpy if _gather_kernel is None else _gather_kernel

    def work(first: int) -> None:
        part = slice(first, first + size)
        counts = [None if each is None else each[part] for each in (seen, exponents)]
        own = shifted(matrices, first)
        kernel(points[part], planes, arrays, own, how, *counts, flat=flat, by_depth=by_depth, nearest=nearest)

    see_through(in_order(work, range(0, n, size), workers), size, n, progress)


def scatter(points: Array, planes: Floats, array: Array, matrix: Floats, progress: Progress | None = None) -> None:
    """Add to `array` (m_x, m_y, m_z) the points' numbers, shared out at their places: the adjoint of `gather`'s sum.

    Each thread has planes of the array of its own, so the result does not depend on their number.
    """
    m, workers = len(array), thread_count(None)
    size = max(1, -(-m // (_SLABS * workers)))
    kernel = _scatter_in_numpy if _scatter_kernel is None else _scatter_kernel
    parts = (slice(first, first + size) for first in range(0, m, size))
    see_through(in_order(lambda part: kernel(points, planes, array, matrix, part), parts, workers), size, m, progress)


def see_through(parts: Iterator[None], size: int, total: int, progress: Progress | None) -> None:
    """Have all parts, of `size` each, done, and say how far they are."""
    for done, _ in enumerate(parts, 1):
        tell(progress, min(done * size, total), total)


def shifted(matrices: Floats, first: int) -> Floats:
    """Matrices for points whose first index is counted from `first`."""
    shifted = matrices.copy()
    shifted[..., 3] += first * shifted[..., 0]
    return shifted


def _places(
    n: tuple[int, int], planes: Array, matrix: Array, m: tuple[int, ...], flat: bool, nearest: float
) -> tuple[Array, Array, Array, Array]:
    """For all points: whether the array has them, the first of the elements around (3, …), the second ones' shares, p3."""
    i, j = np.ogrid[: n[0], : n[1]]
    p = [row[0] * i[..., None] + row[1] * j[..., None] + row[2] * planes + row[3] for row in matrix]
    inside = (p[3] > nearest) & (flat | (p[4] > 0))
    depth = np.where(inside, p[3], 1.0)
    at, share = [], []
    for axis, divisor in enumerate((depth, depth, np.where(inside, p[4], 1.0))):
        place = np.zeros_like(depth) if flat and axis == 2 else p[axis] / divisor
        inside = inside & (place >= -0.5) & (place <= m[axis] - 0.5)
        place = np.where(inside, place, 0.0).clip(0, m[axis] - 1)  # what is not a number is nowhere
        first = np.minimum(place, max(m[axis] - 2, 0)).astype(np.intp)
        at.append(first)
        share.append(place - first)
    return inside, np.stack(at), np.stack(share), depth


def _corners(at: Array, share: Array, m: tuple[int, ...]) -> Any:
    """Indices of the elements around the places, and their shares, one corner after the other."""
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod([s if second else 1 - s for s, second in zip(share, corner, strict=True)], axis=0)
        index = tuple(np.minimum(a + second, most - 1) for a, second, most in zip(at, corner, m, strict=True))
        yield index, weight


def _gather_in_numpy(
    points: Array, planes: Array, arrays: Array, matrices: Floats, how: int, seen: Any, exponents: Any, **others: Any
) -> None:
    flat, by_depth, nearest = others["flat"], others["by_depth"], others["nearest"]
    for array, matrix in zip(arrays, matrices, strict=True):
        for i in range(len(points)):  # plane by plane, in little memory
            places = _places((1, points.shape[1]), planes, shifted(matrix, i), array.shape, flat, nearest)
            inside, at, share, depth = (each[..., 0, :, :] for each in places)
            with np.errstate(invalid="ignore"):  # infinity times a share of 0
                value = sum(array[index] * weight for index, weight in _corners(at, share, array.shape))
            if by_depth:
                value = value / depth**2
            plane = points[i]
            if how == SUM:
                changed = plane + value
            elif how == LEAST:
                changed = np.minimum(plane, value)
            else:
                changed, exponent = np.frexp(plane * value)
                exponents[i] += inside * exponent
            plane[...] = np.where(inside, changed, plane)
            if seen is not None:
                seen[i] += inside


def _scatter_in_numpy(points: Array, planes: Array, array: Array, matrix: Floats, slab: slice) -> None:
    part = array[slab]
    first = slab.indices(len(array))[0]
    for i in range(len(points)):
        places = _places((1, points.shape[1]), planes, shifted(matrix, i), array.shape, False, 0.0)
        inside, at, share, _ = (each[..., 0, :, :] for each in places)
        for index, weight in _corners(at, share, array.shape):
            mine = inside & (index[0] >= first) & (index[0] < first + len(part))
            local = (index[0][mine] - first, index[1][mine], index[2][mine])
            np.add.at(part, local, (points[i] * weight)[mine])
