"""Completeness with which a system samples the directions around a point.

By Tuy's condition a point's neighbourhood can be reconstructed if every plane through the point meets a source, here a
pinhole that sees the point. Seen from the point, a plane is a great circle and the pinholes are points on the sphere of
directions; Orlov's condition for parallel rays has the same form (Metzler, Bowsher and Jaszczak). A stationary scanner
has few pinholes, and most planes miss them all. The measure of completeness is the largest angle by which a plane misses
all pinholes.

References
----------
H. K. Tuy, "An inversion formula for cone-beam reconstruction", SIAM Journal on Applied Mathematics 43 (1983) 546-552.
S. D. Metzler, J. E. Bowsher, R. J. Jaszczak, "Geometrical similarities of the Orlov and Tuy sampling criteria and a
numerical algorithm for assessing sampling completeness", IEEE Transactions on Nuclear Science 50 (2003) 1550-1555.
"""

import functools
import math

import numpy as np

from ..arrays import ArrayLike, Floats, Indexes
from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..validation import positive, real_array
from .performance import seen

TOLERANCE = math.radians(0.1)
"""Default accuracy of a gap, rad: the result may be this much below the true angle."""

_MIN_TOLERANCE = 1e-6  # rad
# Number of patches along each side of a cube's face at the start: about 6 degrees wide, like the gaps of many scanners.
_SIDE = 16
# Numbers of points that are searched together, and of elements of an array, that fit into the processor's cache.
_POINTS = 64
_NUMBERS = 1 << 15
# Middles of a patch's quarters, in units of the patch's half sides.
_QUARTERS = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])


def sampling_gaps(system: PinholeSystem, points: ArrayLike, *, tolerance: float = TOLERANCE) -> Floats:
    """Return the largest angle (P,), rad, by which a plane through each point misses every pinhole that sees the point.

    With unit vectors n normal to the plane and d_k from the point to the pinholes it is
    ``max over n of min over k of asin |n . d_k|``: 0 for complete sampling, pi/2 for a single pinhole or none.

    `points` are (P, 3), world mm. `tolerance` is the accuracy, rad: the result may be this much below the true maximum.
    """
    points = real_array(points, "points", (None, 3))
    if positive(tolerance, "tolerance", "rad") < _MIN_TOLERANCE:
        raise InputError(f"tolerance: expected at least {_MIN_TOLERANCE:g} rad, got {tolerance:g}")
    visible, gaps = seen(system, points), np.full(len(points), math.pi / 2)
    seen_points = np.flatnonzero(visible.any(axis=1))
    for first in range(0, len(seen_points), _POINTS):
        block = seen_points[first : first + _POINTS]
        # The modules that see each point come first; a point that fewer see than another repeats one of them.
        sees = visible[block]
        order = np.argsort(~sees, axis=1, kind="stable")[:, : sees.sum(axis=1).max()]
        order = np.where(np.take_along_axis(sees, order, axis=1), order, order[:, :1])
        vectors = system.centers[order] - points[block, None]
        directions = np.ascontiguousarray((vectors / _lengths(vectors)[..., None]).swapaxes(1, 2))
        gaps[block] = _largest_gaps(directions, tolerance)
    return gaps


def _largest_gaps(directions: Floats, tolerance: float) -> Floats:
    """Return the largest gap (P,), rad, for unit vectors (P, 3, K) to the pinholes, by branch and bound over the normals n.

    When n turns by an angle, the gap changes by at most that angle. So no normal in a patch around n has a gap larger
    than that of n plus the patch's radius. Patches that cannot beat the best gap by more than `tolerance` are dropped;
    the others are quartered.
    """
    best = np.zeros(len(directions))
    all_patches = _initial_patches()
    bounds = _upper_bounds(all_patches, directions, np.arange(len(directions)), best)
    likeliest = bounds == bounds.max(axis=1, keepdims=True)
    for subset in (likeliest, ~likeliest):  # the likeliest patch first: its gap rules out many others
        point, patch = np.nonzero(subset & (bounds > best[:, None] + tolerance))
        patches = all_patches[0, patch]
        while len(point):
            quarters = np.repeat(patches[:, None], 4, axis=1)
            quarters[:, :, 0] += _QUARTERS @ patches[:, 1:]
            quarters[:, :, 1:] /= 2
            parent, child = np.nonzero(_upper_bounds(quarters, directions, point, best) > best[point, None] + tolerance)
            point, patches = point[parent], quarters[parent, child]
    return best


@functools.cache
def _initial_patches() -> Floats:
    """Return patches (1, N, 3, 3) of a cube's surface, each a middle and two half sides, that cover all planes' normals.

    As n and -n describe the same plane, three faces are enough. Seen from the cube's centre, patches are about equal.
    """
    edges = np.tan(np.linspace(-math.pi / 4, math.pi / 4, _SIDE + 1))
    a, b = np.meshgrid((edges[1:] + edges[:-1]) / 2, (edges[1:] + edges[:-1]) / 2)
    half_a, half_b = np.meshgrid(np.diff(edges) / 2, np.diff(edges) / 2)
    zero = np.zeros_like(a)
    face = np.stack([[zero + 1, a, b], [zero, half_a, zero], [zero, zero, half_b]]).reshape(3, 3, -1).transpose(2, 0, 1)
    return np.concatenate([np.roll(face, axis, axis=2) for axis in range(3)])[None]


def _upper_bounds(patches: Floats, directions: Floats, point: Indexes, best: Floats) -> Floats:
    """Return upper bounds (A, N), rad, of the gaps within patches (A or 1, N, 3, 3) for A points, given by their indices.

    Sets the elements of `best` (P,) to the gaps at the patches' middles where these are larger.
    """
    middles, sines = patches[:, :, 0], np.empty((len(point), patches.shape[1]))
    size = max(1, _NUMBERS // (patches.shape[1] * directions.shape[2]))
    for first in range(0, len(point), size):
        block = slice(first, first + size)
        products = (middles if len(middles) == 1 else middles[block]) @ directions[point[block]]
        np.abs(products, out=products).min(axis=2, out=sines[block])
    distance, radius = _lengths(middles), _lengths(patches[:, :, 1] + patches[:, :, 2])
    angles = np.arcsin(np.minimum(sines / distance, 1))
    np.maximum.at(best, point, angles.max(axis=1))
    # Seen from the cube's centre, a length on its face spans at most the angle length / distance.
    return angles + radius / np.maximum(1, distance - radius)


def _lengths(vectors: Floats) -> Floats:
    """Return the lengths (...) of vectors (..., 3)."""
    return np.sqrt(np.einsum("...i,...i", vectors, vectors))
