"""The pinhole: sample points in the hole and in its knife edge, and what they transmit.

All lengths, slopes and coefficients may be numbers, arrays or tensors that broadcast; functions that need to know are given
the `library` whose functions take them, numpy or torch.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, Floats
from ..errors import InputError

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

# More points than this would take hours.
_MOST_POINTS = 1000
# Points across the fine lattice that other point sets are compared with.
_LATTICE = 160
# Positions of the pixels' edges that are tried across an image.
_PLACES = 32

# Gauss-Laguerre nodes and weights beyond the rim: exact along the axis, where transmission falls exponentially.
_ROOT = math.sqrt(2)
_EDGE_RINGS = ((2 - _ROOT, (2 + _ROOT) / 4), (2 + _ROOT, (2 - _ROOT) / 4))
_FEWEST_EDGE_ANGLES = 7


def disk_points(n: int) -> Floats:
    """n points (n, 2) of equal weight in the unit disk: Vogel's spiral (Mathematical Biosciences 44 (1979) 179-189).

    The points are shifted and stretched slightly to have the disk's mean, 0, and its variance, 1/4 in every direction,
    so that even a few give a blur of the right width. One point is the centre; two cannot have this variance.
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
    """The smallest number of `disk_points` (1, 3, 4, ... in steps of a quarter) that images a point source accurately.

    The absolute errors of the image's pixels add up to at most a fraction `tolerance` of its counts, wherever the
    pixels' edges lie. Errors of many point sources add up to at most the same fraction, so the bound holds for any
    activity whose points cast such shadows.

    `shadow` is the diameter of the hole's shadow on the crystal and `pitch` the pixel size along u and v, mm. `blur` is the
    rectangle, mm, that stands for all other blur: a voxel's image, the detector. More than 1000 points are refused.
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


def _point_images(points: Floats, shadow: float, pitch: tuple[float, float], blur: tuple[float, float]) -> Floats:
    """Image of a point source through equally weighted `points` of the unit disk, as fractions of its counts.

    Its shape is (n_v, places, n_u, places), for evenly spaced positions of the pixels' edges along v and u.
    """
    along: list[Floats] = []
    counts: list[int] = []
    for middles, size, width in zip(points.T * (shadow / 2), pitch, blur, strict=True):
        extent = 1.2 * shadow + width  # of the image
        size = min(size, extent)  # a wider pixel cuts the image no more often
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
    """A double-cone hole in an infinitely thick plate: material fills r > radius + |z| tan(alpha / 2)."""

    radius: ArrayOrTensor  # of the hole, mm
    mu: ArrayOrTensor  # 1/mm
    tangent: ArrayOrTensor  # tan(alpha / 2)

    def transmission(
        self, x: ArrayOrTensor, y: ArrayOrTensor, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np
    ) -> ArrayOrTensor:
        """Fraction exp(-mu path) of the photons that pass the edge on lines that cross z = 0 outside the hole.

        Such a line is inside the material between the two cones; one that is steeper than the cone never leaves it. It
        crosses at (x, y), mm from the hole's centre, and goes by the slopes, mm along u and v per mm along the axis.
        """
        slope = slope_u**2 + slope_v**2
        along = x * slope_u + y * slope_v
        beyond = x * x + y * y - self.radius**2
        passes = slope < self.tangent**2
        opens = library.where(passes, self.tangent**2 - slope, 1.0)
        depth = 0.0
        for side in (along, -along):  # |(x, y) + z slope| = radius + z tangent, solved for z, on either side
            closing = self.radius * self.tangent - side
            depth = depth + beyond / ((closing**2 + opens * beyond) ** 0.5 + closing)
        return library.where(passes, library.exp(-self.mu * depth * (1 + slope) ** 0.5), 0.0)

    def points(self, n: int) -> list[tuple[ArrayOrTensor, ArrayOrTensor, ArrayOrTensor]]:
        """Sample points beyond the rim: (x, y) in mm, and the area, mm^2, that each represents.

        They are about as dense as `n` points in the hole. The sum of area times transmission is exact along the axis.
        At 0.7 of the cone's slope it is about 0.1 % of the hole's area off, and close to the cone 1 %.
        """
        depth = self.tangent / (2 * self.mu)  # where a fraction exp(-1) of the rays along the axis pass
        # An odd number, so that no two points are opposite: opposite points transmit the same.
        angles = max(_FEWEST_EDGE_ANGLES, math.ceil(2 * math.sqrt(math.pi * n)) | 1)
        points = []
        for ring, (node, weight) in enumerate(_EDGE_RINGS):
            radius = self.radius + depth * node
            area = 2 * math.pi * radius / angles * depth * weight * math.exp(node)
            turned = 2 * math.pi * (np.arange(angles) + ring / len(_EDGE_RINGS)) / angles
            points += [(radius * math.cos(angle), radius * math.sin(angle), area) for angle in turned]
        return points


@dataclass(frozen=True)
class Opening:
    """A point of the pinhole's plane that rays start from, and the area that it represents."""

    x: ArrayOrTensor  # mm from the hole's centre along u
    y: ArrayOrTensor  # along v
    hole: ArrayOrTensor  # represented area of the hole, mm^2
    knife: KnifeEdge | None = None  # without one the hole is open to every direction
    beyond: Sequence[tuple[ArrayOrTensor, ...]] = ()  # represented points of the edge: x, y, area

    def area(self, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np) -> ArrayOrTensor:
        """Area, mm^2, open to photons with slopes in mm along u and v per mm along the axis."""
        if self.knife is None:
            return self.hole
        area = self.hole * within_cone(slope_u, slope_v, self.knife.tangent, library)
        for x, y, size in self.beyond:
            area = area + size * self.knife.transmission(x, y, slope_u, slope_v, library)
        return area


def openings(n: int, diameter: ArrayOrTensor, knife: KnifeEdge | None = None) -> list[Opening]:
    """Points that represent a hole of the given diameter, mm, by `n` points, and its edge."""
    hole = math.pi / 4 * diameter**2 / n
    beyond = [] if knife is None else knife.points(n)
    if n == 1:  # all rays start from the centre
        return [Opening(0.0, 0.0, hole, knife, beyond)]
    in_hole = [Opening(x * (diameter / 2), y * (diameter / 2), hole, knife) for x, y in disk_points(n).tolist()]
    return in_hole + [Opening(x, y, 0.0, knife, ((x, y, area),)) for x, y, area in beyond]


def within_cone(
    slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, tangent: ArrayOrTensor, library: Any = np
) -> ArrayOrTensor:
    """1 where lines are less steep than the cone, tan(psi) < tangent, else 0."""
    slope = slope_u**2 + slope_v**2
    return library.ones_like(slope) * (slope < tangent**2)
