"""The pinhole: points of its plane that stand for the open hole and for its edge, and what they let pass.

Formulas of a pixel's weight are functions of arrays or of tensors alike.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayOrTensor, namespace
from ..errors import InputError
from ..geometry.collimator import edge_slope

Array = NDArray[np.float64]

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

# More points than this would take hours.
_MOST_POINTS = 1000
# The lattice, points across, that stands for the disk itself where numbers of points are compared.
_LATTICE = 160
# Places across a whole image at which a pixel's edge may cut it.
_PLACES = 32

# Gauss-Laguerre nodes and weights beyond the rim: exact on the axis, where transmission falls exponentially.
_ROOT = math.sqrt(2)
_EDGE_RINGS = ((2 - _ROOT, (2 + _ROOT) / 4), (2 + _ROOT, (2 - _ROOT) / 4))
_FEWEST_EDGE_ANGLES = 7


def disk_points(n: int) -> Array:
    """n points (n, 2) that stand for equal parts of the unit disk: Vogel's spiral, as in the head of a sunflower.

    Shifted and stretched a little, so that their mean is the disk's, 0, and their variance too, 1/4 along every
    direction: the blur has the right width however few the points. 1 point is the middle; 2 have no such variance.

    References
    ----------
    H. Vogel, "A better way to construct the sunflower head", Mathematical Biosciences 44 (1979) 179-189.
    """
    if n == 1:
        return np.zeros((1, 2))
    i = np.arange(n)
    radius = np.sqrt((i + 0.5) / n)[:, None]
    points = radius * np.stack([np.cos(i * _GOLDEN_ANGLE), np.sin(i * _GOLDEN_ANGLE)], axis=1)
    points -= points.mean(axis=0)
    spread = np.linalg.cholesky(points.T @ points / n)
    return points @ np.linalg.inv(spread).T / 2


@functools.lru_cache(maxsize=4096)
def points_needed(tolerance: float, shadow: float, pitch: tuple[float, float], blur: tuple[float, float]) -> int:
    """The fewest of 1, 3, 4 ... `disk_points` (in steps of a quarter) with which a point's image is good enough.

    The sum over the pixels of the absolute error of its image, as a share of its counts, is at most `tolerance`, wherever
    the pixels' edges cut it. The images of many points add up, and so do at most their errors: the bound holds for every
    activity whose points' shadows are like this one.

    Parameters
    ----------
    tolerance
        Above 0.
    shadow
        Diameter of the hole's shadow on the crystal, mm.
    pitch
        Size of a pixel along u and v, mm.
    blur
        What else blurs there, as the sides of a rectangle, mm along u and v: the image of a voxel, the detector.

    Raises
    ------
    InputError
        More than 1000 points are needed.
    """
    ticks = (np.arange(_LATTICE) + 0.5) / _LATTICE * 2 - 1
    lattice = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    exact = _point_images(lattice[(lattice**2).sum(axis=1) < 1], shadow, pitch, blur)
    n = 1
    while np.abs(_point_images(disk_points(n), shadow, pitch, blur) - exact).sum(axis=(0, 2)).max() > tolerance:
        n = 3 if n == 1 else n + math.ceil(n / 4)
        if n > _MOST_POINTS:
            raise InputError(
                f"aperture_tolerance {tolerance:g} takes more than {_MOST_POINTS} points of a hole whose shadow of "
                f"{shadow:.3g} mm falls on pixels of {pitch[0]:.3g} mm: allow more, or give aperture_points"
            )
    return n


def _point_images(points: Array, shadow: float, pitch: tuple[float, float], blur: tuple[float, float]) -> Array:
    """Shares of a point's counts in the pixels around it, seen through `points` of the unit disk alike.

    (n_v, places, n_u, places): for many places of the pixels' edges along v and u, evenly over a pixel.
    """
    along: list[Array] = []
    counts: list[int] = []
    for middles, size, width in zip(points.T * (shadow / 2), pitch, blur, strict=True):
        extent = 1.2 * shadow + width  # of the image
        size = min(size, extent)  # wider pixels cut it no more often
        places = math.ceil(_PLACES * size / extent)
        half = math.ceil(extent / 2 / size) + 1
        edges = np.arange(-half * places, half * places) * (size / places)
        before = np.clip((edges - middles[:, None]) / max(width, 1e-9 * size) + 0.5, 0, 1)
        along.append(before[:, places:] - before[:, :-places])
        counts.append(places)
    images = along[1].T @ along[0] / len(points)
    return images.reshape(-1, counts[1], images.shape[1] // counts[0], counts[0])


@dataclass(frozen=True)
class KnifeEdge:
    """The edge of a hole: what fills r > radius + |z| tan(alpha / 2), a double cone in an infinitely thick plate.

    Attributes
    ----------
    radius, mu, tangent : float
        Of the hole, mm; attenuation coefficient, 1/mm; tan(alpha / 2), `core.collimator.edge_slope`.
    """

    radius: float
    mu: float
    tangent: float

    def transmission(self, x: float, y: float, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor) -> ArrayOrTensor:
        """Share of the photons, exp(-mu path), that pass the edge where they cross the plane z = 0 beyond the rim.

        A line that crosses the plane beyond the rim is in the edge from one cone to the other; one that is steeper than
        the cone never leaves it.

        Parameters
        ----------
        x, y
            Where the line crosses the plane, mm from the hole's middle: at least `radius` from it.
        slope_u, slope_v
            Arrays or tensors: mm along u and v per mm along the axis.
        """
        library = namespace(slope_u)
        slope = slope_u**2 + slope_v**2
        along = x * slope_u + y * slope_v
        beyond = x * x + y * y - self.radius**2
        passes = slope < self.tangent**2
        opens = library.where(passes, self.tangent**2 - slope, 1.0)
        depth = 0.0
        for side in (along, -along):  # |(x, y) + z slope| = radius + z tangent, solved for z, on either side
            closing = self.radius * self.tangent - side
            depth = depth + beyond / (library.sqrt(closing**2 + opens * beyond) + closing)
        return library.where(passes, library.exp(-self.mu * depth * library.sqrt(1 + slope)), 0.0)

    def points(self, n: int) -> list[tuple[float, float, float]]:
        """Points beyond the rim, (x, y) mm, and the area, mm^2, for which each stands.

        They stand about as close as `n` points in the hole. The sum of area times transmission is exact along the axis;
        aslant it is about 0.1 % of the hole's area off at 0.7 of the cone's slope, and 1 % shortly before it.

        Parameters
        ----------
        n
            Points in the hole.
        """
        depth = self.tangent / (2 * self.mu)  # from the rim to where exp(-1) of the rays along the axis pass
        # An odd number: opposite places let the same share pass, and no two of these are opposite.
        angles = max(_FEWEST_EDGE_ANGLES, math.ceil(2 * math.sqrt(math.pi * n)) | 1)
        points: list[tuple[float, float, float]] = []
        for ring, (node, weight) in enumerate(_EDGE_RINGS):
            radius = self.radius + depth * node
            area = 2 * math.pi * radius / angles * depth * weight * math.exp(node)
            turned = 2 * math.pi * (np.arange(angles) + ring / len(_EDGE_RINGS)) / angles
            points += [(radius * math.cos(angle), radius * math.sin(angle), area) for angle in turned]
        return points


@dataclass(frozen=True)
class Opening:
    """A point of the pinhole's plane from which rays start, and for how much of the plane they stand.

    Attributes
    ----------
    x, y : float
        mm from the hole's middle along u and v.
    hole : float
        Area of the hole, mm^2, for which the point stands.
    knife : KnifeEdge, optional
        None: the hole is open to every direction.
    beyond : sequence of (x, y, area)
        Points of the edge for which it stands too.
    """

    x: float
    y: float
    hole: float
    knife: KnifeEdge | None = None
    beyond: Sequence[tuple[float, float, float]] = ()

    def area(self, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor) -> ArrayOrTensor:
        """Area, mm^2, open to photons of a slope (mm along u and v per mm along the axis; arrays or tensors)."""
        if self.knife is None:
            return self.hole
        area = self.hole * within_cone(slope_u, slope_v, self.knife.tangent)
        for x, y, size in self.beyond:
            area = area + size * self.knife.transmission(x, y, slope_u, slope_v)
        return area


def openings(n: int, diameter: float, knife: KnifeEdge | None = None) -> list[Opening]:
    """The points that stand for a hole of a diameter (mm), `n` of them in it, and for its edge."""
    points = diameter / 2 * disk_points(n)
    hole = math.pi / 4 * diameter**2 / n
    beyond = [] if knife is None else knife.points(n)
    if n == 1:  # all from the middle
        return [Opening(0.0, 0.0, hole, knife, beyond)]
    in_hole = [Opening(float(x), float(y), hole, knife) for x, y in points]
    return in_hole + [Opening(x, y, 0.0, knife, ((x, y, area),)) for x, y, area in beyond]


def paix_diameter(diameter: Array, mu: float | None, opening_angle: float) -> Array:
    """Paix's effective diameter ``sqrt(d (d + 2 / mu tan(alpha / 2)))``, mm, of knife-edge holes of diameter d, mm.

    The opaque hole that lets as many photons pass. `mu`, 1/mm, is the material's (None: opaque, d itself), and
    `opening_angle`, rad, the full angle alpha of the edge's double cone.
    """
    if mu is None:
        return diameter
    return np.sqrt(diameter * (diameter + 2 / mu * edge_slope(opening_angle)))


def half_value_diameter(diameter: Array, mu: float | None, opening_angle: float) -> Array:
    """Diameter ``d + ln(2) / mu tan(alpha / 2)``, mm, at which a knife edge lets half of the axial photons pass.

    Beyond the rim of a hole of diameter d, mm, at radius r, the edge is ``2 (r - d / 2) / tan(alpha / 2)`` thick. So it
    is the full width at half maximum of the hole's shadow: the resolution-equivalent diameter of Accorsi and Metzler.
    Arguments as in `paix_diameter`.
    """
    if mu is None:
        return diameter
    return diameter + math.log(2) / mu * edge_slope(opening_angle)


def within_cone(slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, tangent: float) -> ArrayOrTensor:
    """1 where lines are less steep than a cone, tan(psi) < tangent, else 0."""
    slope = slope_u**2 + slope_v**2
    return namespace(slope).ones_like(slope) * (slope < tangent**2)
