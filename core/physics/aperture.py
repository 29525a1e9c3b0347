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
# Beyond this attenuation nothing passes that counts.
_MOST_ATTENUATION = 12.0


def _rings_of_plate() -> list[tuple[float, float]]:
    """Nodes and weights beyond the rim in a plate, by its attenuation: aslant, its edge is up to twice as wide."""
    (x, w), (y, v) = (np.polynomial.legendre.leggauss(n) for n in (6, 4))  # type: ignore[no-untyped-call]
    x, y = (x + 1) / 2, (y + 1) / 2  # denser at the rim
    return [*zip((x**2).tolist(), (w * x).tolist(), strict=True), *zip((1 + y).tolist(), (v / 2).tolist(), strict=True)]


_RINGS_OF_PLATE = _rings_of_plate()


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
            hole = f"a hole whose shadow of {shadow:.3g} mm falls on pixels of {pitch[0]:.3g} mm"
            found = f"aperture_tolerance {tolerance:g} takes more than {_MOST_POINTS} points of {hole}"
            raise InputError(f"{found}: allow more, or give aperture_points")
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
    """A double-cone hole in the middle of a plate: material fills r > radius + |z| tan(alpha / 2) between its faces."""

    radius: ArrayOrTensor  # of the hole, mm
    mu: ArrayOrTensor  # 1/mm
    tangent: ArrayOrTensor  # tan(alpha / 2)
    plate: ArrayOrTensor = None  # thickness, mm; None: infinite

    def transmission(
        self, x: ArrayOrTensor, y: ArrayOrTensor, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np
    ) -> ArrayOrTensor:
        """Fraction exp(-mu path) of the photons that pass the edge on lines that cross z = 0 outside the hole.

        Such a line is inside the material between the two cones; one that is steeper than the cone never leaves it. It
        crosses at (x, y), mm from the hole's centre, and goes by the slopes, mm along u and v per mm along the axis.
        Through a plate with faces, lines of any slope pass, inside the hole and outside.
        """
        if self.plate is not None:
            return self._through_plate(x, y, slope_u, slope_v, library)
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

    def _through_plate(self, x: Any, y: Any, slope_u: Any, slope_v: Any, library: Any) -> ArrayOrTensor:
        slope, face = slope_u**2 + slope_v**2, self.plate / 2
        along, beyond = x * slope_u + y * slope_v, x * x + y * y - self.radius**2
        steeper = slope - self.tangent**2
        safe = library.where(abs(steeper) < 1e-12, 1e-12 + 0 * steeper, steeper)
        depth = 0.0
        for side in (along, -along):  # |(x, y) + z slope| > radius + z tangent, on either side
            half = side - self.radius * self.tangent
            root = half * half - safe * beyond
            crosses = root > 0
            root = library.where(crosses, root, 1.0) ** 0.5
            ends = [(-half - sign * root) / safe for sign in (1, -1)]
            first, last = (library.where(z > 0, library.where(z < face, z, face), 0.0) for z in ends)
            hole = library.where(crosses, last - first, 0.0)  # less steep, it is what lies beside
            depth = depth + library.where(safe > 0, face - hole, -hole)
        return library.exp(-self.mu * depth * (1 + slope) ** 0.5)

    def through(self, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np) -> ArrayOrTensor:
        """Fraction of the photons that pass the plate where it is solid."""
        if self.plate is None:
            return 0.0
        return library.exp(-self.mu * self.plate * (1 + slope_u**2 + slope_v**2) ** 0.5)

    def reach(self, depth: Any, along: Any, across: Any) -> Any:
        """How far from the hole's middle, mm, lines pass a `depth` of the edge, mm along the axis.

        Their slopes are `along` the way from the middle to where they cross the hole's plane, and `across` it. Between faces
        this is exact where either is 0: parallel lines that pass up to some depth fill an ellipse.
        """
        steep = self.tangent + abs(along)
        longer = depth * steep / (2 * self.tangent)  # on the side where the edge recedes from the line
        if self.plate is not None:
            longer = np.minimum(longer, self.plate / 2)
        return ((self.radius + (depth - longer) * steep) ** 2 - (depth / 2 * across) ** 2) ** 0.5

    def points(self, n: int) -> list[tuple[ArrayOrTensor, ArrayOrTensor, ArrayOrTensor]]:
        """Sample points beyond the rim: (x, y) in mm, and the area, mm^2, that each represents.

        They are about as dense as `n` points in the hole. The sum of area times transmission is exact along the axis.
        At 0.7 of the cone's slope it is about 0.1 % of the hole's area off, and close to the cone 1 %.
        """
        depth = self.tangent / (2 * self.mu)  # where a fraction exp(-1) of the rays along the axis pass
        rings: Any = [(node, weight * math.exp(node)) for node, weight in _EDGE_RINGS]
        if self.plate is not None:
            most = ((self.mu * self.plate) ** -4 + _MOST_ATTENUATION**-4) ** -0.25  # the smaller one
            rings = [(most * node, most * weight) for node, weight in _RINGS_OF_PLATE]
        # An odd number, so that no two points are opposite: opposite points transmit the same.
        angles = max(_FEWEST_EDGE_ANGLES, math.ceil(2 * math.sqrt(math.pi * n)) | 1)
        points = []
        for ring, (node, weight) in enumerate(rings):
            radius = self.radius + depth * node
            area = 2 * math.pi * radius / angles * depth * weight
            turned = 2 * math.pi * (np.arange(angles) + ring / 2) / angles
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
        """Area, mm^2, open to photons with slopes in mm along u and v per mm along the axis.

        What would pass the plate were it solid is not in it.
        """
        if self.knife is None:
            return self.hole
        passes = within_cone(slope_u, slope_v, self.knife.tangent, library)
        area, through = self.hole * passes, self.knife.through(slope_u, slope_v, library) * passes
        for x, y, size in self.beyond:
            area = area + size * (self.knife.transmission(x, y, slope_u, slope_v, library) * passes - through)
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
