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

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .checks import positive, real_array
from .errors import InputError
from .performance import seen
from .system import PinholeSystem

Array = NDArray[np.float64]

TOLERANCE = math.radians(0.1)
"""How far below the true angle a gap may be, rad, unless another tolerance is asked for."""

_FINEST = 1e-6  # rad
# Squares along each side of a face of the cube at the start.
_COARSE = 4
# So many patches wait at most: three more with every halving, of which the finest tolerance takes about 20.
_PATCHES = 3 * (_COARSE**2 + 40)


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
    visible, gaps = seen(system, points), np.empty(len(points))
    _kernel()(points, system.centers, visible, float(tolerance), gaps)
    return gaps


def _kernel() -> Any:
    try:
        from numba import types  # not before it is needed: it takes a second
    except ImportError as error:
        raise InputError("completeness of the sampling: needs numba (pip install numba)") from error

    from .projector.compiling import compiled

    vectors = types.Array(types.float64, 2, "C", readonly=True)
    visible = types.Array(types.boolean, 2, "C", readonly=True)
    return compiled(_gaps, types.void(vectors, vectors, visible, types.float64, types.float64[::1]))


def _gaps(points, centers, visible, tolerance, gaps):  # type: ignore[no-untyped-def]  # compiled by numba
    """Branch and bound over the normals n.

    The angle of a plane to the nearest pinhole changes at most as fast as n turns. So a patch of normals around n holds no
    larger gap than that of n plus the patch's radius, and patches that cannot beat the best by more than `tolerance` are
    left out. n and -n are one plane: three faces of a cube, cut into ever smaller squares, hold all.
    """
    towards = np.empty((len(centers), 3))
    faces = np.empty(_PATCHES, np.int64)
    patches = np.empty((_PATCHES, 3))  # the middle's two coordinates on the face, and half the side
    best_n, n = np.array([0.0, 0.0, 1.0]), np.empty(3)
    for p in range(len(points)):
        count = 0
        for m in range(len(centers)):
            if visible[p, m]:
                x, y, z = centers[m, 0] - points[p, 0], centers[m, 1] - points[p, 1], centers[m, 2] - points[p, 2]
                length = math.sqrt(x * x + y * y + z * z)
                towards[count, 0], towards[count, 1], towards[count, 2] = x / length, y / length, z / length
                count += 1
        if count == 0:
            gaps[p] = math.pi / 2
            continue
        # The last point's worst plane is a good one to begin with.
        sine = 1.0
        for k in range(count):
            sine = min(sine, abs(best_n[0] * towards[k, 0] + best_n[1] * towards[k, 1] + best_n[2] * towards[k, 2]))
        best = math.asin(sine)
        top = 0
        for face in range(3):
            for i in range(_COARSE):
                for j in range(_COARSE):
                    faces[top] = face
                    patches[top, 0], patches[top, 1] = (2 * i + 1) / _COARSE - 1, (2 * j + 1) / _COARSE - 1
                    patches[top, 2] = 1 / _COARSE
                    top += 1
        while top > 0:
            top -= 1
            face = faces[top]
            a, b, half = patches[top, 0], patches[top, 1], patches[top, 2]
            # Seen from the cube's middle, what is on its face turns at most by length over distance.
            near_a, near_b = max(abs(a) - half, 0.0), max(abs(b) - half, 0.0)
            radius = half * math.sqrt(2.0 / (1.0 + near_a * near_a + near_b * near_b))
            enough = best + tolerance - radius
            least = math.sin(min(enough, math.pi / 2)) if enough > 0 else -1.0
            norm = math.sqrt(1.0 + a * a + b * b)
            n[face], n[(face + 1) % 3], n[(face + 2) % 3] = 1.0 / norm, a / norm, b / norm
            sine = 1.0
            for k in range(count):
                sine = min(sine, abs(n[0] * towards[k, 0] + n[1] * towards[k, 1] + n[2] * towards[k, 2]))
                if sine <= least:
                    for i in range(3):  # what rules out this patch will likely rule out the next: look at it first
                        towards[k, i], towards[0, i] = towards[0, i], towards[k, i]
                    break
            if sine <= least:
                continue
            angle = math.asin(sine)
            if angle > best:
                best = angle
                best_n[:] = n
            half /= 2
            for i in range(2):
                for j in range(2):
                    faces[top] = face
                    patches[top, 0], patches[top, 1] = a + (2 * i - 1) * half, b + (2 * j - 1) * half
                    patches[top, 2] = half
                    top += 1
        gaps[p] = best
