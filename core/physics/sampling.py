"""How completely a system samples the directions around a point.

Tuy: a point's neighbourhood can be reconstructed if every plane through the point meets a source, here a pinhole that sees
it. Orlov's condition for parallel rays is the same, of great circles and directions. Metzler, Bowsher and Jaszczak show
how alike they are: as seen from the point, a plane is a great circle on the sphere of directions, and the pinholes are
points on it. A scanner that stands still has a few pinholes, which planes in general miss; so the measure is by what angle
they miss them at most.

References
----------
H. K. Tuy, "An inversion formula for cone-beam reconstruction", SIAM Journal on Applied Mathematics 43 (1983) 546-552.
S. D. Metzler, J. E. Bowsher, R. J. Jaszczak, "Geometrical similarities of the Orlov and Tuy sampling criteria and a
numerical algorithm for assessing sampling completeness", IEEE Transactions on Nuclear Science 50 (2003) 1550-1555.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..validation import positive, real_array
from .performance import seen

Array = NDArray[np.float64]

TOLERANCE = math.radians(0.1)
"""How far below the true angle a gap may be, rad, unless another tolerance is asked for."""

_FINEST = 1e-6  # rad
# Patches along each side of a face of the cube at the start: as small as the gaps of many scanners, 4 degrees.
_SIDE = 16
# Points whose planes are searched together, and numbers of an array: what lies in the processor's cache.
_POINTS = 64
_NUMBERS = 1 << 15
# A patch's quarters: from its middle by half of its half sides.
_QUARTERS = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])


def sampling_gaps(system: PinholeSystem, points: ArrayLike, *, tolerance: float = TOLERANCE) -> Array:
    """The largest angle (P,), rad, by which a plane through each point misses every pinhole that sees the point.

    With unit vectors n across the plane and d_k from the point towards the pinholes it is
    ``max over n of min over k of asin |n . d_k|``: 0 if the sampling is complete, pi/2 for a single pinhole, or for none.

    Parameters
    ----------
    system
        The modules; which of them see a point, `seen` says.
    points
        (P, 3), world mm.
    tolerance
        By how much the result may fall short of the maximum, rad.

    Raises
    ------
    InputError
        A shape is wrong, or a number is not finite or out of its range.
    """
    points = real_array(points, "points", (None, 3))
    if positive(tolerance, "tolerance", "rad") < _FINEST:
        raise InputError(f"tolerance: expected at least {_FINEST:g} rad, got {tolerance:g}")
    visible, gaps = seen(system, points), np.full(len(points), math.pi / 2)
    somewhere = np.flatnonzero(visible.any(axis=1))
    for first in range(0, len(somewhere), _POINTS):
        block = somewhere[first : first + _POINTS]
        gaps[block] = _gaps(_towards(system.centers, points[block], visible[block]), tolerance)
    return gaps


def _towards(centers: Array, points: Array, visible: NDArray[np.bool_]) -> Array:
    """Unit vectors (P, 3, K) from each point towards the pinholes that see it; where those are fewer, one is repeated."""
    order = np.argsort(~visible, axis=1, kind="stable")[:, : visible.sum(axis=1).max()]
    order = np.where(np.take_along_axis(visible, order, axis=1), order, order[:, :1])
    vectors = centers[order] - points[:, None]
    return np.ascontiguousarray((vectors / _lengths(vectors)[..., None]).swapaxes(1, 2))


def _gaps(towards: Array, tolerance: float) -> Array:
    """The largest gap (P,), rad, between `towards` (P, 3, K): branch and bound over the normals n.

    The angle of a plane to the nearest pinhole changes at most as fast as n turns. So a patch of normals around n holds no
    larger gap than that of n plus the patch's radius, and patches that cannot beat the best by more than `tolerance` are
    left out; the others are cut into quarters.
    """
    best = np.zeros(len(towards))
    whole = _patches()
    bounds = _bounds(whole, towards, np.arange(len(towards)), best)
    likeliest = bounds == bounds.max(axis=1, keepdims=True)
    for some in (likeliest, ~likeliest):  # what is found in one rules out many others
        point, patch = np.nonzero(some & (bounds > best[:, None] + tolerance))
        patches = whole[0, patch]
        while len(point):
            quarters = np.repeat(patches[:, None], 4, axis=1)
            quarters[:, :, 0] += _QUARTERS @ patches[:, 1:]
            quarters[:, :, 1:] /= 2
            parent, child = np.nonzero(_bounds(quarters, towards, point, best) > best[point, None] + tolerance)
            point, patches = point[parent], quarters[parent, child]
    return best


@functools.cache
def _patches() -> Array:
    """Patches (1, N, 3, 3) that hold a normal of every plane: middle, and two half sides, on three faces of a cube.

    n and -n are one plane, so three faces hold all. Seen from the cube's middle the patches are of one size, nearly.
    """
    edges = np.tan(np.linspace(-math.pi / 4, math.pi / 4, _SIDE + 1))
    a, b = np.meshgrid((edges[1:] + edges[:-1]) / 2, (edges[1:] + edges[:-1]) / 2)
    half_a, half_b = np.meshgrid(np.diff(edges) / 2, np.diff(edges) / 2)
    zero = np.zeros_like(a)
    face = np.stack([[zero + 1, a, b], [zero, half_a, zero], [zero, zero, half_b]]).reshape(3, 3, -1).transpose(2, 0, 1)
    return np.concatenate([np.roll(face, axis, axis=2) for axis in range(3)])[None]


def _bounds(patches: Array, towards: Array, point: NDArray[np.intp], best: Array) -> Array:
    """Bounds (A, N) of the gaps in patches (A or 1, N, 3, 3) of points; `best` (P,) learns the gaps in their middle."""
    middles, sines = patches[:, :, 0], np.empty((len(point), patches.shape[1]))
    size = max(1, _NUMBERS // (patches.shape[1] * towards.shape[2]))
    for first in range(0, len(point), size):
        some = slice(first, first + size)
        across = (middles if len(middles) == 1 else middles[some]) @ towards[point[some]]
        np.abs(across, out=across).min(axis=2, out=sines[some])
    distance, radius = _lengths(middles), _lengths(patches[:, :, 1] + patches[:, :, 2])
    angles = np.arcsin(np.minimum(sines / distance, 1))
    np.maximum.at(best, point, angles.max(axis=1))
    # Seen from the cube's middle, what is on its face turns at most by length over distance.
    return angles + radius / np.maximum(1, distance - radius)


def _lengths(vectors: Array) -> Array:
    return np.sqrt(np.einsum("...i,...i", vectors, vectors))
