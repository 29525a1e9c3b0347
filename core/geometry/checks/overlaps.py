"""Parts that penetrate each other and how deep, pinholes inside other modules, and collimators inside the ROI.

Two convex bodies are apart if their projections on some axis are. For polyhedra it is enough to try the normals of both
bodies' faces and the cross products of their edges (S. Gottschalk, M. C. Lin, D. Manocha, "OBBTree", SIGGRAPH 1996). These
are also the normals of the Minkowski difference, so the smallest overlap of the projections is the shortest translation that
separates the bodies (S. Cameron, R. K. Culley, IEEE ICRA 1986).
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ...arrays import Floats, Indexes
from ..collimator import Collimator
from ..system import PinholeSystem
from .hulls import TOUCH, Hulls
from .report import Intrusion, NearPair, Overlap, SwallowedPinhole

_CHUNK = 500  # pairs at a time, which take about 50 MB
_PARALLEL = 1e-12  # sine of the angle between edges that span no plane
_TRIPLES = np.array(list(combinations(range(12), 3)))  # faces of two bodies that may meet in a corner


def find_overlaps(hulls: Hulls) -> tuple[Overlap, ...]:
    """All pairs of parts of different modules whose hulls are more than `TOUCH` inside each other."""
    pairs = []  # of which the bounding spheres meet
    for p in range(len(hulls) - 1):
        distance = np.linalg.norm(hulls.centers[p + 1 :] - hulls.centers[p], axis=1)
        near = distance < hulls.radii[p + 1 :] + hulls.radii[p]
        others = p + 1 + np.flatnonzero(near & (hulls.numbers[p + 1 :] != hulls.numbers[p]))
        pairs.append(np.stack([np.full(len(others), p), others]))
    near_pairs = np.concatenate(pairs, axis=1)
    found = []
    for start in range(0, near_pairs.shape[1], _CHUNK):
        i, j = near_pairs[:, start : start + _CHUNK]
        depths = penetration_depths(hulls, i, j)
        deep = depths > TOUCH
        i, j, depths = i[deep], j[deep], depths[deep]
        for a, b, depth, point in zip(i, j, depths.tolist(), _common_points(hulls, i, j).tolist(), strict=True):
            first, second = int(hulls.numbers[a]), int(hulls.numbers[b])
            found.append(Overlap(first, hulls.kinds[a], second, hulls.kinds[b], depth, tuple(point)))
    return tuple(found)


def penetration_depths(hulls: Hulls, i: Indexes, j: Indexes) -> Floats:
    """Shortest translations (N,), mm, that separate hulls `i` from hulls `j`; 0 or less where they are apart."""
    across = np.cross(hulls.edges[i][:, :, None], hulls.edges[j][:, None]).reshape(len(i), -1, 3)
    axes = np.concatenate([hulls.normals[i], hulls.normals[j], across], axis=1)
    lengths = np.linalg.norm(axes, axis=2)
    parallel = lengths < _PARALLEL
    axes /= np.where(parallel, 1.0, lengths)[:, :, None]
    a = axes @ hulls.vertices[i].transpose(0, 2, 1)
    b = axes @ hulls.vertices[j].transpose(0, 2, 1)
    shared = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
    return np.where(parallel, np.inf, shared).min(axis=1)


def _common_points(hulls: Hulls, i: Indexes, j: Indexes) -> Floats:
    """Points (N, 3) inside both hull `i` and hull `j`, which overlap: the mean corner of the intersection."""
    normals = np.concatenate([hulls.normals[i], hulls.normals[j]], axis=1)
    offsets = np.concatenate([hulls.offsets[i], hulls.offsets[j]], axis=1)
    planes = normals[:, _TRIPLES]
    meet = np.abs(np.linalg.det(planes)) > 1e-9
    planes[~meet] = np.eye(3)
    corners = np.linalg.solve(planes, offsets[:, _TRIPLES][..., None])[..., 0]
    outside = (corners @ normals.transpose(0, 2, 1) - offsets[:, None]).max(axis=2)
    weights = (meet & (outside < 0.1 * TOUCH)).astype(np.float64)
    return np.einsum("nc,ncx->nx", weights, corners) / weights.sum(axis=1)[:, None]


def find_near_pairs(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[NearPair, ...]:
    """Modules whose pinholes are closer together than their fronts can stand side by side."""
    half = np.array([body.front_half_width for body in collimators])
    found = []
    for m, number in enumerate(system.numbers.tolist()):
        distance = np.linalg.norm(system.centers[m + 1 :] - system.centers[m], axis=1)
        near = np.flatnonzero(distance < half[m + 1 :] + half[m] - TOUCH)
        found += [NearPair(number, int(system.numbers[m + 1 + n]), float(distance[n])) for n in near]
    return tuple(found)


def find_swallowed_pinholes(system: PinholeSystem, hulls: Hulls) -> tuple[SwallowedPinhole, ...]:
    """Pinhole centres more than `TOUCH` inside another module's part."""
    found = []
    for number, center in zip(system.numbers.tolist(), system.centers, strict=True):
        depth = (hulls.offsets - hulls.normals @ center).min(axis=1)
        inside = np.flatnonzero((depth > TOUCH) & (hulls.numbers != number))
        found += [SwallowedPinhole(number, int(hulls.numbers[p]), hulls.kinds[p], float(depth[p])) for p in inside]
    return tuple(found)


def find_intrusions(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[Intrusion, ...]:
    """Modules that reach into the largest ROI: how deep the nearest point of their plate's front face is inside."""
    radius = float(system.roi_radius.max())
    front = np.array([(body.front_half_width, body.construction.front) for body in collimators])
    u, v, height = system.isocentres().T
    beside = [np.maximum(abs(x) - front[:, 0], 0.0) for x in (u, v)]
    depth = radius - np.sqrt(beside[0] ** 2 + beside[1] ** 2 + (height + front[:, 1]) ** 2)
    return tuple(Intrusion(int(system.numbers[m]), radius, float(depth[m])) for m in np.flatnonzero(depth > TOUCH))
