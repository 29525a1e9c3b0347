"""Points of a pixel's area from which rays start: a pixel is an area, and one ray through its centre misses small sources.

The points form a rank-1 lattice in the pixel, and so one lattice over all pixels. A voxel throws a shadow on the detector;
its total counts are the sum of its chords over the points within that shadow, an integral that is approximated by a sum
over a lattice. By Poisson's summation formula the error is a sum over the dual lattice of the shadow's Fourier transform,
which for a box is a product of three sincs: so the number of points that a voxel of some size and distance needs is
computed, not found by trial.

References
----------
I. H. Sloan, S. Joe, "Lattice Methods for Multiple Integration", Oxford University Press (1994).
"""

import functools
import math

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid
from ..geometry.views import Views

TOLERANCE = 0.02
"""Default of the largest relative error of the total counts of a single voxel."""

MOST_POINTS = 2584
"""Largest number of points of a pixel; the rays of more would take hours."""

_FIBONACCI = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377, 610, 987, 1597, MOST_POINTS)

# Largest error over all places of a voxel between the points, in units of the root mean square over them. Boxes seen along
# an axis, the worst, have up to 2.9 on average and seldom more than 4.
_LARGEST_ERROR = 4.0
# Number of voxels examined along each axis of a grid, and of those, with the smallest shadows, that decide.
_VOXELS_ALONG, _VOXELS = 9, 48
# Limits of the vectors k of the dual lattice that are examined: of |k_u k_v| / n, and of |k_u| / n and |k_v| / n.
_DUAL_NEAR, _DUAL_FAR = 6, 3


@functools.lru_cache(maxsize=256)
def lattice(n: int) -> Floats:
    """Return n points (n, 2) of the unit square around 0, (column, row): a rank-1 lattice, even along either side.

    It is the lattice whose shortest dual vectors keep farthest from the axes, since voxels' shadows often have their edges
    along these. A single point is the centre.
    """
    i = np.arange(n)
    points = (np.stack([i, i * _generator(n) % n], axis=1) + 0.5) / n - 0.5
    points.setflags(write=False)
    return points


@functools.lru_cache(maxsize=256)
def _generator(n: int) -> int:
    """Return the generator g of the lattice of n points: row i g modulo n in column i."""
    if n in _FIBONACCI:  # the Fibonacci number before is the best generator
        return _FIBONACCI[_FIBONACCI.index(n) - 1] if n > 1 else 0
    i = np.arange(1, n)

    def merit(g: int) -> int:
        """Return the smallest product of a point's cyclic row and column distances, cells, from the first point."""
        row = i * g % n
        return int((np.minimum(i, n - i) * np.minimum(row, n - row)).min())

    return max((g for g in range(1, n // 2 + 1) if math.gcd(g, n) == 1), key=merit)


def lattices(n: int, n_all: int) -> Floats:
    """Return the starts (n_all, 2), in the pixel, of the lattices of a hole's n points and of the points of its edge."""
    return np.concatenate([lattice(k) for k in (n, n_all - n) if k])


@functools.lru_cache(maxsize=256)
def _dual(n: int) -> Floats:
    """Return vectors k (N, 2) of the dual of `lattice(n)`, of which k . x is whole for all points x.

    There is one of each pair k, -k, and not 0. They are those that matter for boxes, whose transform falls as 1 / (k_u k_v):
    near the axes also far ones.
    """
    column, period = np.meshgrid(np.arange(_DUAL_FAR * n + 1), np.arange(-_DUAL_FAR, _DUAL_FAR), indexing="ij")
    row = -column * (pow(_generator(n), -1, n) if n > 1 else 0) % n + n * period
    matters = (column * np.abs(row) <= _DUAL_NEAR * n) & (np.abs(row) <= _DUAL_FAR * n)
    matters &= (column > 0) | (row > 0)
    return np.stack([column[matters], row[matters]], axis=1).astype(np.float64)


def expected_error(edges: Floats, n: int, hole_points: int = 1) -> float:
    """Return the largest relative error of a single voxel's total counts, wherever the voxel lies between the rays.

    Parameters
    ----------
    edges
        Shadows of the three edges of D voxels on the detector, (D, 3, 2), pixels, from `shadow_edges`.
    n
        Number of points of the pixel.
    hole_points
        Number of points of the hole, each with its own n points of the pixel, whose errors are independent.
    """
    waves = np.sinc(np.einsum("dij,nj->din", edges, _dual(n))).prod(axis=1)
    return _LARGEST_ERROR * float(np.sqrt(2 * (waves**2).sum(axis=1).max(initial=0.0) / hole_points))


def points_needed(edges: Floats, tolerance: float, hole_points: int = 1) -> int:
    """Return the smallest number of points of the pixel with an `expected_error` of at most `tolerance`.

    It is a Fibonacci number, and at most `MOST_POINTS`, whether that is enough or not. `edges` and `hole_points` are those
    of `expected_error`.
    """
    rounded = np.round(edges, 6)
    return _points_needed(rounded.tobytes(), len(rounded), tolerance, hole_points)


@functools.lru_cache(maxsize=8192)
def _points_needed(edges: bytes, n_voxels: int, tolerance: float, hole_points: int) -> int:
    """Return `points_needed` for edges (n_voxels, 3, 2) as bytes, which can be a key of the cache, by bisection."""
    edge_array = np.frombuffer(edges).reshape(n_voxels, 3, 2)
    lower, upper = -1, len(_FIBONACCI) - 1
    while upper - lower > 1:
        middle = (lower + upper) // 2
        if expected_error(edge_array, _FIBONACCI[middle], hole_points) <= tolerance:
            upper = middle
        else:
            lower = middle
    return _FIBONACCI[upper]


def shadow_edges(views: Views, m: int, grid: Grid) -> Floats:
    """Return the edges (D, 3, 2) of voxels' shadows on view m's detector, pixels, for the voxels that need most points.

    They are voxels in front of the source and within the image, or, if there are none, in front of the source.
    """
    ticks = [np.unique(np.linspace(0, n - 1, min(n, _VOXELS_ALONG)).round()) for n in grid.shape]
    centers = moved(grid.affine, np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3))
    matrix = views[m].projection_matrices()[0]
    column, row, factor = matrix[:, :3] @ centers.T + matrix[:, 3:]
    nearest = 1e-6 * np.abs(factor).max()  # a voxel at the source has no shadow
    is_front = factor > nearest
    factor = np.where(is_front, factor, 1.0)
    position = np.stack([column, row], axis=1) / factor[:, None]
    voxel_edges = matrix[:, :3] @ grid.affine[:3, :3]
    edges = (voxel_edges[:2].T - position[:, None, :] * voxel_edges[2][:, None]) / factor[:, None, None]
    n_v, n_u = views.shape
    reach = np.abs(edges).sum(axis=1) / 2
    is_inside = (np.abs(position - [(n_u - 1) / 2, (n_v - 1) / 2]) < np.array([n_u, n_v]) / 2 + reach).all(axis=1)
    edges = edges[is_front & is_inside] if (is_front & is_inside).any() else edges[is_front]
    pairs = ((0, 1), (1, 2), (2, 0))
    area = sum(np.abs(edges[:, a, 0] * edges[:, b, 1] - edges[:, a, 1] * edges[:, b, 0]) for a, b in pairs)
    return edges[np.argsort(area)[:_VOXELS]]


def require_points(value: object, name: str) -> int | None:
    """Return `value` as a number of points of a pixel, None for automatic; raise `InputError` if it is neither."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 1 <= value <= MOST_POINTS:
        raise InputError(f"{name}: expected a whole number from 1 to {MOST_POINTS}, or None: automatic; got {value!r}")
    return int(value)


def offsets(n: int, shift: Floats | None = None) -> Floats:
    """Return `lattice(n)` moved cyclically by `shift` (2,): (n, 2), columns and rows from -1/2 to 1/2 of a pixel."""
    return lattice(n) if shift is None else (lattice(n) + shift + 0.5) % 1 - 0.5
