"""Checks for overlaps: parts that penetrate each other, pinholes inside other modules, and collimators inside the ROI.

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
from .report import Intrusion, NearPair, PartOverlap, SwallowedPinhole

_CHUNK = 500  # number of pairs at a time, which take about 50 MB
_PARALLEL = 1e-12  # sine of the angle between two edges up to which they span no plane
_TRIPLES = np.array(list(combinations(range(12), 3)))  # triples of the faces of two bodies, which may meet in a corner


def find_overlaps(hulls: Hulls) -> tuple[PartOverlap, ...]:
    """Find all pairs of parts of different modules whose hulls are more than `TOUCH` inside each other."""
    pairs = []  # pairs whose bounding spheres meet
    for p in range(len(hulls) - 1):
        distance = np.linalg.norm(hulls.centers[p + 1 :] - hulls.centers[p], axis=1)
        near = distance < hulls.radii[p + 1 :] + hulls.radii[p]
        partners = p + 1 + np.flatnonzero(near & (hulls.numbers[p + 1 :] != hulls.numbers[p]))
        pairs.append(np.stack([np.full(len(partners), p), partners]))
    near_pairs = np.concatenate(pairs, axis=1)
    findings = []
    for start in range(0, near_pairs.shape[1], _CHUNK):
        i, j = near_pairs[:, start : start + _CHUNK]
        depths = penetration_depths(hulls, i, j)
        deep = depths > TOUCH
        i, j, depths = i[deep], j[deep], depths[deep]
        for a, b, depth, point in zip(i, j, depths.tolist(), _common_points(hulls, i, j).tolist(), strict=True):
            first, second = int(hulls.numbers[a]), int(hulls.numbers[b])
            findings.append(PartOverlap(first, hulls.kinds[a], second, hulls.kinds[b], depth, tuple(point)))
    return tuple(findings)


def penetration_depths(hulls: Hulls, i: Indexes, j: Indexes) -> Floats:
    """Return the shortest translations (N,), mm, that separate hulls `i` from hulls `j`, (N,) each; <= 0 if apart."""
    edge_normals = np.cross(hulls.edges[i][:, :, None], hulls.edges[j][:, None]).reshape(len(i), -1, 3)
    axes = np.concatenate([hulls.normals[i], hulls.normals[j], edge_normals], axis=1)
    lengths = np.linalg.norm(axes, axis=2)
    parallel = lengths < _PARALLEL
    axes /= np.where(parallel, 1.0, lengths)[:, :, None]
    a = axes @ hulls.vertices[i].transpose(0, 2, 1)
    b = axes @ hulls.vertices[j].transpose(0, 2, 1)
    overlaps = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
    return np.where(parallel, np.inf, overlaps).min(axis=1)


def _common_points(hulls: Hulls, i: Indexes, j: Indexes) -> Floats:
    """Return points (N, 3), world mm, inside both of overlapping hulls `i` and `j`: mean corners of the intersections."""
    normals = np.concatenate([hulls.normals[i], hulls.normals[j]], axis=1)
    offsets = np.concatenate([hulls.offsets[i], hulls.offsets[j]], axis=1)
    planes = normals[:, _TRIPLES]
    is_corner = np.abs(np.linalg.det(planes)) > 1e-9
    planes[~is_corner] = np.eye(3)
    corners = np.linalg.solve(planes, offsets[:, _TRIPLES][..., None])[..., 0]
    distance_outside = (corners @ normals.transpose(0, 2, 1) - offsets[:, None]).max(axis=2)
    weights = (is_corner & (distance_outside < 0.1 * TOUCH)).astype(np.float64)
    return np.einsum("nc,ncx->nx", weights, corners) / weights.sum(axis=1)[:, None]


def find_near_pairs(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[NearPair, ...]:
    """Find the pairs of modules whose pinholes are closer together than their fronts can stand side by side."""
    half_widths = np.array([collimator.front_half_width for collimator in collimators])
    findings = []
    for m, number in enumerate(system.numbers.tolist()):
        distance = np.linalg.norm(system.centers[m + 1 :] - system.centers[m], axis=1)
        near = np.flatnonzero(distance < half_widths[m + 1 :] + half_widths[m] - TOUCH)
        findings += [NearPair(number, int(system.numbers[m + 1 + n]), float(distance[n])) for n in near]
    return tuple(findings)


def find_swallowed_pinholes(system: PinholeSystem, hulls: Hulls) -> tuple[SwallowedPinhole, ...]:
    """Find the pinhole centres that are more than `TOUCH` inside another module's part."""
    findings = []
    for number, center in zip(system.numbers.tolist(), system.centers, strict=True):
        depth = (hulls.offsets - hulls.normals @ center).min(axis=1)
        inside = np.flatnonzero((depth > TOUCH) & (hulls.numbers != number))
        findings += [SwallowedPinhole(number, int(hulls.numbers[p]), hulls.kinds[p], float(depth[p])) for p in inside]
    return tuple(findings)


def find_intrusions(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[Intrusion, ...]:
    """Find the modules that reach into the largest ROI, judged by the nearest point of their plate's front face."""
    radius = float(system.roi_radius.max())
    fronts = np.array([(collimator.front_half_width, collimator.construction.front) for collimator in collimators])
    u, v, height = system.isocentres().T
    aside = [np.maximum(abs(x) - fronts[:, 0], 0.0) for x in (u, v)]
    depth = radius - np.sqrt(aside[0] ** 2 + aside[1] ** 2 + (height + fronts[:, 1]) ** 2)
    return tuple(Intrusion(int(system.numbers[m]), radius, float(depth[m])) for m in np.flatnonzero(depth > TOUCH))
