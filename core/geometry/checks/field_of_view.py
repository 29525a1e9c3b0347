"""ROIs that lie partly outside the field of view, and modules that stand between a pinhole and its ROI.

**Coverage.** A module sees a point fully if the rays from it through every point of the hole meet the crystal. At depth x in
front of the pinhole these are the points within ``w(x) = x s - d/2`` of the axis along u and v, with ``s = (Ld - d)/(2 l)``.
The largest sphere at the isocentre that fits has the radius `PinholeSystem.roi_radius_seen`.

**Blocking.** `RAYS` rays run from each pinhole's centre over the cone of its ROI; each stands for the same solid angle (a
spiral by the golden angle: H. Vogel, Math. Biosci. 44 (1979) 179-189). About ten of them fall into a thousandth of the cone.
A ray counts from the pinhole to where it leaves the ROI, and is cut exactly by the hulls of the other modules. Hulls hide no
more than the parts do: a ray that enters a collimator through its hole ends in its wall or in the crystal.
"""

import numpy as np

from ...arrays import Bools, Floats, Indexes
from ..frames import module_frames
from ..system import PinholeSystem
from .hulls import TOUCH, Hulls
from .report import Blocked, Uncovered

SLACK = 0.01
"""Shortfall of the field of view, mm of radius, that is accepted: l may be rounded to 0.01 mm."""
RAYS = 10_000

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)  # type: ignore[no-untyped-call]


def find_uncovered(system: PinholeSystem) -> tuple[Uncovered, ...]:
    """Modules whose field of view is smaller than their ROI by more than `SLACK`."""
    d, radius, seen = system.pinhole_diameter, system.roi_radius, system.roi_radius_seen()
    slope = (system.detector_side - d) / (2 * system.collimator_length)
    return tuple(
        Uncovered(
            int(system.numbers[m]), float(radius[m]), float(seen[m]),
            unseen_share(system.isocentres()[m], d[m], slope[m], radius[m]),
        )
        for m in np.flatnonzero(radius - seen > SLACK)
    )  # fmt: skip


def unseen_share(middle: Floats, d: float, slope: float, radius: float) -> float:
    """Fraction of the volume of a sphere of `radius`, mm, that is outside the field of view.

    Its `middle` (3,) is in the module's frame, mm. The volume is integrated over planes across the axis: in each, the field
    of view is a square of half-width w(x) around the axis, and the sphere a disc around `middle`.
    """
    u, v, h = middle
    ends = [h - radius, h + radius, d / (2 * slope)]  # with the pyramid's apex
    # Where the square's sides and corners reach the rim of the disc: (w - a)^2 [+ (w - c)^2] = radius^2 - (x - h)^2.
    aside = [(a,) for a in (u, -u, v, -v)] + [(a, c) for a in (u, -u) for c in (v, -v)]
    for places in aside:
        constants = [d / 2 + place for place in places]
        n, total, squares = len(places), sum(constants), sum(c**2 for c in constants)
        roots = np.roots([n * slope**2 + 1, -2 * (slope * total + h), squares + h**2 - radius**2])
        ends += roots[np.isreal(roots)].real.tolist()
    planes = np.unique(np.clip(ends, h - radius, h + radius))
    low, high = planes[:-1, None], planes[1:, None]
    # In steps of an angle, because the integrand behaves like a square root at the ends of the pieces.
    angle = (_NODES + 1) * np.pi / 2
    x = low + (high - low) * (1 - np.cos(angle)) / 2
    weight = (high - low) / 2 * np.sin(angle) * _WEIGHTS * np.pi / 2
    disc = np.sqrt(np.maximum(radius**2 - (x - h) ** 2, 0.0))
    half = np.maximum(x * slope - d / 2, 0.0)
    ends_u, ends_v = ((half - x, -half - x) for x in (u, v))
    corners = ((_disc_below(disc, a, c), i == j) for i, a in enumerate(ends_u) for j, c in enumerate(ends_v))
    seen = sum(area if adds else -area for area, adds in corners)
    return float((weight * (np.pi * disc**2 - seen)).sum() / (4 / 3 * np.pi * radius**3))


def _disc_below(radius: Floats, a: Floats, b: Floats) -> Floats:
    """Area of the part of discs around 0 in which one coordinate is below `a` and the other below `b`."""
    a, b = np.clip(a, -radius, radius), np.clip(b, -radius, radius)
    with np.errstate(invalid="ignore", divide="ignore"):
        sectors = [radius**2 * np.arcsin(np.nan_to_num(x / radius)) + x * np.sqrt(radius**2 - x**2) for x in (a, b)]
    inside = a * b + (sectors[0] + sectors[1]) / 2 + np.pi * radius**2 / 4
    below = [sector + np.pi * radius**2 / 2 for sector in sectors]  # with one of the bounds alone
    both = np.where(a < 0, np.where(b < 0, 0.0, below[0]), np.where(b < 0, below[1], sectors[0] + sectors[1]))
    return np.where(a**2 + b**2 < radius**2, inside, both)


def find_blocked(system: PinholeSystem, hulls: Hulls) -> tuple[Blocked, ...]:
    """Pairs of a module and another one that some of its rays hit."""
    found = []
    b, frames = system.pinhole_distance, module_frames(system.centers)  # whose axes go through the isocentre
    for m, number in enumerate(system.numbers.tolist()):
        radius, pinhole = system.roi_radius[m], system.centers[m]
        parts = _candidates(hulls, pinhole, frames[m, 2], b[m], radius)
        parts = parts[hulls.numbers[parts] != number]
        if len(parts) == 0:
            continue
        local = cone_directions(RAYS, np.sqrt(1 - (radius / b[m]) ** 2))
        along = b[m] * local[:, 2]
        leaves = along + np.sqrt(np.maximum(radius**2 - (b[m] ** 2 - along**2), 0.0))
        directions = local @ frames[m]
        for other in dict.fromkeys(hulls.numbers[parts].tolist()):
            hit = np.zeros(RAYS, dtype=bool)
            for p in parts[hulls.numbers[parts] == other]:
                hit |= hits(hulls, p, pinhole, directions, leaves)
            if hit.any():
                found.append(Blocked(number, other, float(hit.mean())))
    return tuple(found)


def cone_directions(n: int, cosine: float) -> Floats:
    """`n` unit vectors (n, 3), spread evenly over the cone around z whose half-angle has the given cosine."""
    index = np.arange(n)
    z = 1 - (1 - cosine) * (index + 0.5) / n
    angle = index * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def hits(hulls: Hulls, p: int, origin: Floats, directions: Floats, lengths: Floats) -> Bools:
    """Which rays (N,) from `origin` along unit `directions` (N, 3), with `lengths` (N,), pass through hull `p`."""
    towards = hulls.normals[p] @ directions.T
    towards[towards == 0] = -np.finfo(np.float64).tiny  # parallel to a face
    outside = hulls.offsets[p] - hulls.normals[p] @ origin  # below 0: outside this face
    with np.errstate(over="ignore"):
        at = outside[:, None] / towards
    # Clipped to the ray, which begins at 0 and ends at its length.
    enters = np.where(towards < 0, at, 0.0).max(axis=0)
    leaves = np.where(towards > 0, at, lengths).min(axis=0)
    return leaves - enters > TOUCH


def _candidates(hulls: Hulls, pinhole: Floats, axis: Floats, b: float, radius: float) -> Indexes:
    """Parts with a corner in front of the pinhole, whose bounding sphere meets the cone of the ROI."""
    in_front = ((hulls.vertices - pinhole) @ axis).max(axis=1) > 0
    return np.flatnonzero(in_front & in_cone(hulls, pinhole, axis, np.arcsin(radius / b), b + radius))


def in_cone(hulls: Hulls, tip: Floats, axis: Floats, half: float, length: float) -> Bools:
    """Which bounding spheres meet a cone of half-angle `half` around a unit `axis`, within `length` of its tip."""
    to = hulls.centers - tip
    distance = np.linalg.norm(to, axis=1)
    width = np.arcsin(np.minimum(hulls.radii / np.maximum(distance, TOUCH), 1.0))
    angle = np.arccos(np.clip(to @ axis / np.maximum(distance, TOUCH), -1, 1))
    return (distance <= hulls.radii) | ((angle < half + width) & (distance - hulls.radii < length))
