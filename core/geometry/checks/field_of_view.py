"""Checks of the field of view: ROIs partly outside it, and modules that stand between a pinhole and its ROI.

**Coverage.** A module sees a point fully if the rays from the point through every point of the hole meet the crystal. At
depth x in front of the pinhole these are the points within ``w(x) = x s - d/2`` of the axis along u and v, with
``s = (Ld - d)/(2 l)``. The largest sphere at the isocentre that fits has the radius `PinholeSystem.roi_radius_seen`.

**Blocking.** `RAYS` rays run from each pinhole's centre over the cone of its ROI; each represents the same solid angle (a
spiral by the golden angle: H. Vogel, Math. Biosci. 44 (1979) 179-189). About ten of them fall into a thousandth of the cone.
A ray runs from the pinhole to the point at which it leaves the ROI, and is cut exactly by the hulls of the other modules. A
hull blocks no more rays than its part: a ray that enters a collimator through its hole ends in its wall or in the crystal.
"""

import numpy as np

from ...arrays import Bools, Floats, Indexes
from ..frames import module_frames
from ..system import PinholeSystem
from .hulls import TOUCH, Hulls
from .report import Blocked, Uncovered

SLACK = 0.01
"""Accepted shortfall of the field of view's radius, mm: l may be rounded to 0.01 mm."""
RAYS = 10_000
"""Number of rays from each pinhole."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)  # type: ignore[no-untyped-call]


def find_uncovered(system: PinholeSystem) -> tuple[Uncovered, ...]:
    """Find the modules whose field of view is smaller than their ROI by more than `SLACK`."""
    d, radius, seen_radius = system.pinhole_diameter, system.roi_radius, system.roi_radius_seen()
    slope = (system.detector_side - d) / (2 * system.collimator_length)
    return tuple(
        Uncovered(
            int(system.numbers[m]), float(radius[m]), float(seen_radius[m]),
            unseen_share(system.isocentres()[m], d[m], slope[m], radius[m]),
        )
        for m in np.flatnonzero(radius - seen_radius > SLACK)
    )  # fmt: skip


def unseen_share(middle: Floats, d: float, slope: float, radius: float) -> float:
    """Return the fraction of a sphere's volume that is outside a module's field of view.

    The sphere of `radius`, mm, is around `middle` (3,), mm in the module's frame; the field of view has the half-width
    ``w(x) = x slope - d/2``, mm. The volume is integrated over planes normal to the axis: in each, the field of view is a
    square of half-width w(x) around the axis, and the sphere is a disc around `middle`.
    """
    u, v, h = middle
    ends = [h - radius, h + radius, d / (2 * slope)]  # ends of the sphere, and the apex of the field of view
    # Depths at which the square's sides and corners cross the disc's rim: (w - a)^2 [+ (w - c)^2] = radius^2 - (x - h)^2.
    sides_and_corners = [(a,) for a in (u, -u, v, -v)] + [(a, c) for a in (u, -u) for c in (v, -v)]
    for coordinates in sides_and_corners:
        constants = [d / 2 + coordinate for coordinate in coordinates]
        n, total, squares = len(coordinates), sum(constants), sum(c**2 for c in constants)
        roots = np.roots([n * slope**2 + 1, -2 * (slope * total + h), squares + h**2 - radius**2])
        ends += roots[np.isreal(roots)].real.tolist()
    planes = np.unique(np.clip(ends, h - radius, h + radius))
    low, high = planes[:-1, None], planes[1:, None]
    # The nodes are even in an angle, because the integrand behaves like a square root at the ends of the pieces.
    angle = (_NODES + 1) * np.pi / 2
    x = low + (high - low) * (1 - np.cos(angle)) / 2
    weight = (high - low) / 2 * np.sin(angle) * _WEIGHTS * np.pi / 2
    disc_radius = np.sqrt(np.maximum(radius**2 - (x - h) ** 2, 0.0))
    half_width = np.maximum(x * slope - d / 2, 0.0)
    ends_u, ends_v = ((half_width - x, -half_width - x) for x in (u, v))
    corners = ((_disc_below(disc_radius, a, c), i == j) for i, a in enumerate(ends_u) for j, c in enumerate(ends_v))
    seen_area = sum(area if is_added else -area for area, is_added in corners)
    return float((weight * (np.pi * disc_radius**2 - seen_area)).sum() / (4 / 3 * np.pi * radius**3))


def _disc_below(radius: Floats, a: Floats, b: Floats) -> Floats:
    """Return the area of the part of discs around 0 in which one coordinate is below `a` and the other below `b`."""
    a, b = np.clip(a, -radius, radius), np.clip(b, -radius, radius)
    with np.errstate(invalid="ignore", divide="ignore"):
        sectors = [radius**2 * np.arcsin(np.nan_to_num(x / radius)) + x * np.sqrt(radius**2 - x**2) for x in (a, b)]
    corner_inside = a * b + (sectors[0] + sectors[1]) / 2 + np.pi * radius**2 / 4
    below = [sector + np.pi * radius**2 / 2 for sector in sectors]  # areas with one of the two bounds alone
    corner_outside = np.where(a < 0, np.where(b < 0, 0.0, below[0]), np.where(b < 0, below[1], sectors[0] + sectors[1]))
    return np.where(a**2 + b**2 < radius**2, corner_inside, corner_outside)


def find_blocked(system: PinholeSystem, hulls: Hulls) -> tuple[Blocked, ...]:
    """Find the pairs of a module and another module that stands in the way of some of its rays."""
    findings = []
    b, frames = system.pinhole_distance, module_frames(system.centers)  # untilted: the axes go through the isocentre
    for m, number in enumerate(system.numbers.tolist()):
        radius, pinhole = system.roi_radius[m], system.centers[m]
        parts = _candidates(hulls, pinhole, frames[m, 2], b[m], radius)
        parts = parts[hulls.numbers[parts] != number]
        if len(parts) == 0:
            continue
        local = cone_directions(RAYS, np.sqrt(1 - (radius / b[m]) ** 2))
        along = b[m] * local[:, 2]
        ray_lengths = along + np.sqrt(np.maximum(radius**2 - (b[m] ** 2 - along**2), 0.0))
        directions = local @ frames[m]
        for blocker in dict.fromkeys(hulls.numbers[parts].tolist()):
            is_hit = np.zeros(RAYS, dtype=bool)
            for p in parts[hulls.numbers[parts] == blocker]:
                is_hit |= hits(hulls, p, pinhole, directions, ray_lengths)
            if is_hit.any():
                findings.append(Blocked(number, blocker, float(is_hit.mean())))
    return tuple(findings)


def cone_directions(n: int, cosine: float) -> Floats:
    """Return `n` unit vectors (n, 3), spread evenly over the cone around z whose half-angle has this cosine."""
    index = np.arange(n)
    z = 1 - (1 - cosine) * (index + 0.5) / n
    angle = index * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def hits(hulls: Hulls, p: int, origin: Floats, directions: Floats, lengths: Floats) -> Bools:
    """Return the mask (N,) of rays that pass through hull `p`.

    The rays start at `origin` (3,), run along the unit vectors `directions` (N, 3), and have `lengths` (N,), mm.
    """
    cosines = hulls.normals[p] @ directions.T
    cosines[cosines == 0] = -np.finfo(np.float64).tiny  # parallel to a face
    heights = hulls.offsets[p] - hulls.normals[p] @ origin  # below 0 if the origin is outside the face
    with np.errstate(over="ignore"):
        crossings = heights[:, None] / cosines  # distances along the ray to each face's plane
    # The segment inside the hull is clipped to the ray, which begins at 0 and ends at its length.
    enters = np.where(cosines < 0, crossings, 0.0).max(axis=0)
    leaves = np.where(cosines > 0, crossings, lengths).min(axis=0)
    return leaves - enters > TOUCH


def _candidates(hulls: Hulls, pinhole: Floats, axis: Floats, b: float, radius: float) -> Indexes:
    """Return the indices of the parts that may block rays of a pinhole.

    They have a corner in front of the pinhole, and a bounding sphere that meets the cone of its ROI.
    """
    in_front = ((hulls.vertices - pinhole) @ axis).max(axis=1) > 0
    return np.flatnonzero(in_front & in_cone(hulls, pinhole, axis, np.arcsin(radius / b), b + radius))


def in_cone(hulls: Hulls, tip: Floats, axis: Floats, half_angle: float, length: float) -> Bools:
    """Return the mask (P,) of hulls whose bounding spheres meet a cone around a unit `axis`, up to `length` from its tip."""
    from_tip = hulls.centers - tip
    distance = np.linalg.norm(from_tip, axis=1)
    angular_radius = np.arcsin(np.minimum(hulls.radii / np.maximum(distance, TOUCH), 1.0))
    angle = np.arccos(np.clip(from_tip @ axis / np.maximum(distance, TOUCH), -1, 1))
    return (distance <= hulls.radii) | ((angle < half_angle + angular_radius) & (distance - hulls.radii < length))
