"""Aperture: sample points in a pinhole and in its knife edge, and the fractions of photons that pass there.

All lengths, slopes and coefficients may be numbers, arrays or tensors that broadcast. `library` is the module whose
functions take them, NumPy or torch.
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

# Largest number of points; with more, a projection would take hours.
_MAX_POINTS = 1000
# Number of points across the fine lattice to which other point sets are compared.
_LATTICE = 160
# Number of tried positions of the pixels' edges across an image.
_POSITIONS = 32

# Gauss-Laguerre nodes and weights beyond the rim: exact along the axis, where transmission falls exponentially.
_ROOT = math.sqrt(2)
_EDGE_RINGS = ((2 - _ROOT, (2 + _ROOT) / 4), (2 + _ROOT, (2 - _ROOT) / 4))
_MIN_EDGE_ANGLES = 7
# Attenuation mu * path beyond which transmission is negligible.
_MAX_ATTENUATION = 12.0


def _plate_nodes() -> list[tuple[float, float]]:
    """Return quadrature nodes and weights beyond the rim in a plate, in units of its attenuation.

    They reach to 2, because the edge is up to twice as wide for oblique lines.
    """
    (x, w), (y, v) = (np.polynomial.legendre.leggauss(n) for n in (6, 4))  # type: ignore[no-untyped-call]
    x, y = (x + 1) / 2, (y + 1) / 2  # squared below, so that nodes are denser at the rim
    return [*zip((x**2).tolist(), (w * x).tolist(), strict=True), *zip((1 + y).tolist(), (v / 2).tolist(), strict=True)]


_PLATE_RINGS = _plate_nodes()


def disk_points(n: int) -> Floats:
    """Return n points (n, 2) of equal weight in the unit disk: Vogel's spiral (Mathematical Biosciences 44 (1979) 179-189).

    The points are shifted and stretched slightly to have the disk's mean, 0, and its variance, 1/4 in every direction,
    so that even a few give a blur of the right width. One point is the centre; two points cannot have this variance.
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
    """Return the smallest number of `disk_points` (1, 3, 4, ... in steps of a quarter) that images a point accurately.

    The absolute errors of the image's pixels add up to at most a fraction `tolerance` of its counts, wherever the
    pixels' edges lie. Errors of many point sources add up to at most the same fraction, so the bound holds for any
    activity whose points cast such shadows.

    `shadow` is the diameter of the hole's shadow on the crystal and `pitch` the pixel size along u and v, mm. `blur` are the
    sides of a rectangle, mm, that represents all other blur: a voxel's image, the detector. Raises `InputError` if more than
    1000 points are needed.
    """
    ticks = (np.arange(_LATTICE) + 0.5) / _LATTICE * 2 - 1
    lattice = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    exact = _point_images(lattice[(lattice**2).sum(axis=1) < 1], shadow, pitch, blur)
    n = 1
    while np.abs(_point_images(disk_points(n), shadow, pitch, blur) - exact).sum(axis=(0, 2)).max() > tolerance:
        n = 3 if n == 1 else n + math.ceil(n / 4)
        if n > _MAX_POINTS:
            hole = f"a hole whose shadow of {shadow:.3g} mm falls on pixels of {pitch[0]:.3g} mm"
            problem = f"aperture_tolerance {tolerance:g} takes more than {_MAX_POINTS} points of {hole}"
            raise InputError(f"{problem}: allow a larger tolerance, or give aperture_points")
    return n


def _point_images(points: Floats, shadow: float, pitch: tuple[float, float], blur: tuple[float, float]) -> Floats:
    """Return the image of a point source through equally weighted `points` of the unit disk, as fractions of its counts.

    Its shape is (n_v, positions, n_u, positions), for evenly spaced positions of the pixels' edges along v and u. The other
    arguments are those of `points_needed`.
    """
    profiles: list[Floats] = []  # fraction of each point's counts in each pixel, along u and v
    n_positions: list[int] = []
    for middles, size, width in zip(points.T * (shadow / 2), pitch, blur, strict=True):
        extent = 1.2 * shadow + width  # size of the image on the crystal, mm
        size = min(size, extent)  # a wider pixel cuts the image no more often
        n = math.ceil(_POSITIONS * size / extent)
        half = math.ceil(extent / 2 / size) + 1
        edges = np.arange(-half * n, half * n) * (size / n)
        fraction_below = np.clip((edges - middles[:, None]) / max(width, 1e-9 * size) + 0.5, 0, 1)
        profiles.append(fraction_below[:, n:] - fraction_below[:, :-n])
        n_positions.append(n)
    images = profiles[1].T @ profiles[0] / len(points)
    return images.reshape(-1, n_positions[1], images.shape[1] // n_positions[0], n_positions[0])


@dataclass(frozen=True)
class KnifeEdge:
    """Double-cone hole in the middle of a plate: material fills r > radius + |z| tan(alpha / 2) between the faces."""

    radius: ArrayOrTensor  # radius of the hole, mm
    mu: ArrayOrTensor  # attenuation coefficient of the plate, 1/mm
    tangent: ArrayOrTensor  # tan(alpha / 2)
    plate: ArrayOrTensor = None  # thickness of the plate, mm; None: infinite

    def transmission(
        self, x: ArrayOrTensor, y: ArrayOrTensor, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np
    ) -> ArrayOrTensor:
        """Return the fraction exp(-mu path) of the photons that pass the edge on lines that cross z = 0 outside the hole.

        A line crosses z = 0 at (x, y), mm from the hole's centre, with slopes in mm along u and v per mm along the axis. In
        an infinite plate its path in the material is that between the two cones; a line steeper than the cone never leaves
        it. A plate with faces is passed by lines of any slope, inside the hole and outside.
        """
        if self.plate is not None:
            return self._through_plate(x, y, slope_u, slope_v, library)
        squared_slope = slope_u**2 + slope_v**2
        along = x * slope_u + y * slope_v
        beyond = x * x + y * y - self.radius**2
        passes = squared_slope < self.tangent**2
        opening = library.where(passes, self.tangent**2 - squared_slope, 1.0)
        depth = 0.0
        for side in (along, -along):  # |(x, y) + z slope| = radius + z tangent, solved for z, on either side
            closing = self.radius * self.tangent - side
            depth = depth + beyond / ((closing**2 + opening * beyond) ** 0.5 + closing)
        return library.where(passes, library.exp(-self.mu * depth * (1 + squared_slope) ** 0.5), 0.0)

    def _through_plate(self, x: Any, y: Any, slope_u: Any, slope_v: Any, library: Any) -> ArrayOrTensor:
        """Return the `transmission` of a plate with faces at z = -plate / 2 and plate / 2."""
        squared_slope, face = slope_u**2 + slope_v**2, self.plate / 2
        along, beyond = x * slope_u + y * slope_v, x * x + y * y - self.radius**2
        steepness = squared_slope - self.tangent**2
        steepness = library.where(abs(steepness) < 1e-12, 1e-12 + 0 * steepness, steepness)
        depth = 0.0
        for side in (along, -along):  # |(x, y) + z slope| > radius + z tangent, on either side
            half = side - self.radius * self.tangent
            root = half * half - steepness * beyond
            crosses = root > 0
            root = library.where(crosses, root, 1.0) ** 0.5
            ends = [(-half - sign * root) / steepness for sign in (1, -1)]
            first, last = (library.where(z > 0, library.where(z < face, z, face), 0.0) for z in ends)
            # Between its roots a line steeper than the cone is in the hole. A less steep one is in the material, and its
            # roots come in falling order.
            between = library.where(crosses, last - first, 0.0)
            depth = depth + library.where(steepness > 0, face - between, -between)
        return library.exp(-self.mu * depth * (1 + squared_slope) ** 0.5)

    def solid_transmission(self, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np) -> ArrayOrTensor:
        """Return the fraction of the photons of these slopes that pass the plate where it is solid."""
        if self.plate is None:
            return 0.0
        return library.exp(-self.mu * self.plate * (1 + slope_u**2 + slope_v**2) ** 0.5)

    def reach(self, depth: Any, along: Any, across: Any) -> Any:
        """Return the distance, mm, from the hole's centre at which lines pass a `depth` of the edge, mm along the axis.

        The distance is measured in the hole's plane; `along` and `across` are the line's slopes along and across the
        direction from the centre to its crossing. Parallel lines that pass up to some depth fill an ellipse; between the
        faces of a plate this is exact if either slope is 0.
        """
        steepness = self.tangent + abs(along)
        longer = depth * steepness / (2 * self.tangent)  # part of the depth where the edge recedes from the line
        if self.plate is not None:
            longer = np.minimum(longer, self.plate / 2)
        return ((self.radius + (depth - longer) * steepness) ** 2 - (depth / 2 * across) ** 2) ** 0.5

    def points(self, n: int) -> list[tuple[ArrayOrTensor, ArrayOrTensor, ArrayOrTensor]]:
        """Return sample points beyond the rim: x and y, mm, and the area, mm^2, that each represents.

        They are about as dense as `n` points in the hole. The sum of area times transmission is exact along the axis. Its
        error is about 0.1 % of the hole's area at 0.7 of the cone's slope, and 1 % close to the cone.
        """
        depth = self.tangent / (2 * self.mu)  # distance beyond the rim at which exp(-1) of the axial photons pass
        rings: Any = [(node, weight * math.exp(node)) for node, weight in _EDGE_RINGS]
        if self.plate is not None:
            attenuation = ((self.mu * self.plate) ** -4 + _MAX_ATTENUATION**-4) ** -0.25  # a smooth minimum
            rings = [(attenuation * node, attenuation * weight) for node, weight in _PLATE_RINGS]
        # An odd number, so that no two points are opposite: opposite points transmit the same.
        n_angles = max(_MIN_EDGE_ANGLES, math.ceil(2 * math.sqrt(math.pi * n)) | 1)
        points = []
        for ring, (node, weight) in enumerate(rings):
            radius = self.radius + depth * node
            area = 2 * math.pi * radius / n_angles * depth * weight
            angles = 2 * math.pi * (np.arange(n_angles) + ring / 2) / n_angles
            points += [(radius * math.cos(angle), radius * math.sin(angle), area) for angle in angles]
        return points


@dataclass(frozen=True)
class Opening:
    """Point of the pinhole's plane from which rays start, and the area that it represents."""

    x: ArrayOrTensor  # mm from the hole's centre along u
    y: ArrayOrTensor  # mm from the hole's centre along v
    hole: ArrayOrTensor  # represented area of the hole, mm^2
    knife: KnifeEdge | None = None  # edge of the hole; without one the hole is open to every direction
    edge_points: Sequence[tuple[ArrayOrTensor, ...]] = ()  # represented points of the edge: x and y, mm, area, mm^2

    def area(self, slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, library: Any = np) -> ArrayOrTensor:
        """Return the area, mm^2, open to photons with slopes in mm along u and v per mm along the axis.

        It is less than the sum over the points by the photons that would pass the plate if it were solid.
        """
        if self.knife is None:
            return self.hole
        passes = within_cone(slope_u, slope_v, self.knife.tangent, library)
        area, solid = self.hole * passes, self.knife.solid_transmission(slope_u, slope_v, library) * passes
        for x, y, size in self.edge_points:
            area = area + size * (self.knife.transmission(x, y, slope_u, slope_v, library) * passes - solid)
        return area


def openings(n: int, diameter: ArrayOrTensor, knife: KnifeEdge | None = None) -> list[Opening]:
    """Return the openings that represent a hole of this diameter, mm, by `n` points, and its edge by further ones."""
    area = math.pi / 4 * diameter**2 / n
    edge_points = [] if knife is None else knife.points(n)
    if n == 1:  # all rays start from the centre
        return [Opening(0.0, 0.0, area, knife, edge_points)]
    in_hole = [Opening(x * (diameter / 2), y * (diameter / 2), area, knife) for x, y in disk_points(n).tolist()]
    return in_hole + [Opening(x, y, 0.0, knife, ((x, y, size),)) for x, y, size in edge_points]


def within_cone(
    slope_u: ArrayOrTensor, slope_v: ArrayOrTensor, tangent: ArrayOrTensor, library: Any = np
) -> ArrayOrTensor:
    """Return 1 for lines that are less steep than the cone, slope^2 < tangent^2, else 0."""
    squared_slope = slope_u**2 + slope_v**2
    return library.ones_like(squared_slope) * (squared_slope < tangent**2)
