"""Points of a pixel's area from which rays start: a pixel is an area, and one ray through its centre misses small sources.

The points form a rank-1 lattice in the pixel, and so one lattice over all pixels. A voxel throws a shadow on the detector;
its total counts are the sum of its chords over the points within that shadow, which is right to as much as the sum over
a lattice stands for an integral. By Poisson's summation formula that error is a sum over the dual lattice of the
shadow's Fourier transform, which for a box is a product of three sincs: so the number of points that a voxel of a size at
a distance asks for is computed, not tried.

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
"""By default the total counts of a single voxel are right to this share of them."""

MOST_POINTS = 2584
"""The most points of a pixel: its rays would take hours."""

_FIBONACCI = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377, 610, 987, 1597, MOST_POINTS)

# The largest error, over all places of a voxel between the points, in units of the root mean square over them. Boxes seen
# along an axis, the worst, were found to have up to 2.9 on average and seldom more than 4.
_LARGEST_ERROR = 4.0
# Voxels looked at along each axis of a grid, and how many of those, the smallest as the detector sees them, decide.
_VOXELS_ALONG = 9
_VOXELS = 48
# Vectors of the dual lattice that are looked at: |k_u k_v| up to this times n, and either up to that times n.
_DUAL_NEAR, _DUAL_FAR = 6, 3


@functools.lru_cache(maxsize=256)
def lattice(n: int) -> Floats:
    """n points (n, 2) of the unit square around 0, (column, row): a rank-1 lattice, which also fills either side evenly.

    The one whose shortest dual vectors keep farthest from the axes, since voxels' shadows often have their edges along
    these. 1 point is the middle.
    """
    i = np.arange(n)
    points = (np.stack([i, i * _generator(n) % n], axis=1) + 0.5) / n - 0.5
    points.setflags(write=False)
    return points


@functools.lru_cache(maxsize=256)
def _generator(n: int) -> int:
    if n in _FIBONACCI:  # known to be best
        return _FIBONACCI[_FIBONACCI.index(n) - 1] if n > 1 else 0
    i = np.arange(1, n)

    def merit(g: int) -> int:
        across = i * g % n
        return int((np.minimum(i, n - i) * np.minimum(across, n - across)).min())

    return max((g for g in range(1, n // 2 + 1) if math.gcd(g, n) == 1), key=merit)


def lattices(n: int, n_all: int) -> Floats:
    """Where in the pixel those lattices begin (n_all, 2) that belong to n points of a hole, and to the rest, of its edge."""
    return np.concatenate([lattice(k) for k in (n, n_all - n) if k])


@functools.lru_cache(maxsize=256)
def _dual(n: int) -> Floats:
    """Vectors (N, 2) of the dual of `lattice(n)`, one of each pair k, -k, without 0: k . x is whole for every point x.

    Those that count for boxes, whose transform falls as 1 / (k_u k_v): near the axes the far ones, too.
    """
    column, turn = np.meshgrid(np.arange(_DUAL_FAR * n + 1), np.arange(-_DUAL_FAR, _DUAL_FAR), indexing="ij")
    row = -column * (pow(_generator(n), -1, n) if n > 1 else 0) % n + n * turn
    chosen = (column * np.abs(row) <= _DUAL_NEAR * n) & (np.abs(row) <= _DUAL_FAR * n)
    chosen &= (column > 0) | (row > 0)
    return np.stack([column[chosen], row[chosen]], axis=1).astype(np.float64)


def expected_error(edges: Floats, n: int, hole_points: int = 1) -> float:
    """Largest error of a single voxel's total counts, as a share of them, wherever it lies between the rays.

    Parameters
    ----------
    edges
        (D, 3, 2): the shadows of voxels' three edges on the detector, pixels, from `shadow_edges`.
    n
        Points of the pixel.
    hole_points
        Points of the hole, each with n of its own in the pixel, whose errors are independent of one another.
    """
    waves = np.sinc(np.einsum("dij,nj->din", edges, _dual(n))).prod(axis=1)
    return _LARGEST_ERROR * float(np.sqrt(2 * (waves**2).sum(axis=1).max(initial=0.0) / hole_points))


def points_needed(edges: Floats, tolerance: float, hole_points: int = 1) -> int:
    """The fewest points of the pixel (a Fibonacci number) with which `expected_error` is at most `tolerance`.

    At most `MOST_POINTS`, be that enough or not. Arguments as in `expected_error`.
    """
    rounded = np.round(edges, 6)
    return _points_needed(rounded.tobytes(), len(rounded), tolerance, hole_points)


@functools.lru_cache(maxsize=8192)
def _points_needed(edges: bytes, n_voxels: int, tolerance: float, hole_points: int) -> int:
    of_voxels = np.frombuffer(edges).reshape(n_voxels, 3, 2)
    below, enough = -1, len(_FIBONACCI) - 1
    while enough - below > 1:
        middle = (below + enough) // 2
        if expected_error(of_voxels, _FIBONACCI[middle], hole_points) <= tolerance:
            enough = middle
        else:
            below = middle
    return _FIBONACCI[enough]


def shadow_edges(views: Views, m: int, grid: Grid) -> Floats:
    """Edges (D, 3, 2) of the shadows of some voxels on view m's detector, pixels: those that ask for most points.

    They are among the voxels in front of the source and within the image; where none is, among those in front of it.
    """
    ticks = [np.unique(np.linspace(0, n - 1, min(n, _VOXELS_ALONG)).round()) for n in grid.shape]
    index = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = moved(grid.affine, index)
    matrix = views[m].projection_matrices()[0]
    column, row, factor = matrix[:, :3] @ centers.T + matrix[:, 3:]
    nearest = 1e-6 * np.abs(factor).max()  # a voxel at the source has no shadow to speak of
    front = factor > nearest
    factor = np.where(front, factor, 1.0)
    place = np.stack([column, row], axis=1) / factor[:, None]
    linear = matrix[:, :3] @ grid.affine[:3, :3]  # of the voxels' edges
    edges = (linear[:2].T - place[:, None, :] * linear[2][:, None]) / factor[:, None, None]
    n_v, n_u = views.shape
    reach = np.abs(edges).sum(axis=1) / 2
    inside = (np.abs(place - [(n_u - 1) / 2, (n_v - 1) / 2]) < np.array([n_u, n_v]) / 2 + reach).all(axis=1)
    edges = edges[front & inside] if (front & inside).any() else edges[front]
    pairs = ((0, 1), (1, 2), (2, 0))
    area = sum(np.abs(edges[:, a, 0] * edges[:, b, 1] - edges[:, a, 1] * edges[:, b, 0]) for a, b in pairs)
    return edges[np.argsort(area)[:_VOXELS]]


def require_points(value: object, name: str) -> int | None:
    """`value` as a number of points of a pixel, None for an automatic one."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 1 <= value <= MOST_POINTS:
        raise InputError(f"{name}: expected a whole number from 1 to {MOST_POINTS}, or None: automatic; got {value!r}")
    return int(value)


def offsets(n: int, shift: Floats | None = None) -> Floats:
    """`lattice(n)` moved by `shift` (2,) round the pixel: (n, 2), from -1/2 to 1/2 of a pixel along columns and rows."""
    return lattice(n) if shift is None else (lattice(n) + shift + 0.5) % 1 - 0.5
