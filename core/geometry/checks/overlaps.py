"""Parts that penetrate each other, and how deep.

Two convex bodies are apart if their shadows on some axis are, and of polyhedra these axes are enough: the normals of
either's faces and the cross products of either's edges (S. Gottschalk, M. C. Lin, D. Manocha, "OBBTree", SIGGRAPH 1996).
They are also the normals of the bodies' Minkowski difference, so the least overlap of the shadows is the shortest
translation that separates the bodies (S. Cameron, R. K. Culley, IEEE ICRA 1986).
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .hulls import TOUCH, Hulls
from .report import Overlap

_CHUNK = 500  # pairs at a time: some 50 MB
_PARALLEL = 1e-12  # sine of the angle between edges that span no plane
_TRIPLES = np.array(list(combinations(range(12), 3)))  # of two bodies' faces: where they may have a corner


def find_overlaps(hulls: Hulls) -> tuple[Overlap, ...]:
    """All pairs of parts of different modules whose hulls are more than `TOUCH` inside each other."""
    pairs = _near_pairs(hulls)
    found = []
    for start in range(0, len(pairs), _CHUNK):
        i, j = pairs[start : start + _CHUNK].T
        depths = penetration_depths(hulls, i, j)
        deep = depths > TOUCH
        i, j, depths = i[deep], j[deep], depths[deep]
        for a, b, depth, point in zip(i, j, depths.tolist(), _common_points(hulls, i, j).tolist(), strict=True):
            first, second = int(hulls.numbers[a]), int(hulls.numbers[b])
            found.append(Overlap(first, hulls.kinds[a], second, hulls.kinds[b], depth, tuple(point)))
    return tuple(found)


def penetration_depths(hulls: Hulls, i: NDArray[np.intp], j: NDArray[np.intp]) -> NDArray[np.float64]:
    """Shortest translations (N,) that separate hulls `i` from hulls `j`, mm; 0 or less where they are apart."""
    across = np.cross(hulls.edges[i][:, :, None], hulls.edges[j][:, None]).reshape(len(i), -1, 3)
    axes = np.concatenate([hulls.normals[i], hulls.normals[j], across], axis=1)
    lengths = np.linalg.norm(axes, axis=2)
    parallel = lengths < _PARALLEL
    axes /= np.where(parallel, 1.0, lengths)[:, :, None]
    a = axes @ hulls.vertices[i].transpose(0, 2, 1)
    b = axes @ hulls.vertices[j].transpose(0, 2, 1)
    shared = np.minimum(a.max(axis=2) - b.min(axis=2), b.max(axis=2) - a.min(axis=2))
    return np.where(parallel, np.inf, shared).min(axis=1)


def _near_pairs(hulls: Hulls) -> NDArray[np.intp]:
    """Pairs (N, 2) of parts of different modules whose spheres meet."""
    pairs = []
    for p in range(len(hulls) - 1):
        distance = np.linalg.norm(hulls.centers[p + 1 :] - hulls.centers[p], axis=1)
        near = distance < hulls.radii[p + 1 :] + hulls.radii[p]
        near &= hulls.numbers[p + 1 :] != hulls.numbers[p]
        others = p + 1 + np.flatnonzero(near)
        pairs.append(np.column_stack([np.full(len(others), p), others]))
    return np.concatenate(pairs)


def _common_points(hulls: Hulls, i: NDArray[np.intp], j: NDArray[np.intp]) -> NDArray[np.float64]:
    """A point (N, 3) inside hulls `i` and `j` that overlap: the mean of the common body's corners."""
    normals = np.concatenate([hulls.normals[i], hulls.normals[j]], axis=1)
    offsets = np.concatenate([hulls.offsets[i], hulls.offsets[j]], axis=1)
    planes = normals[:, _TRIPLES]
    meet = np.abs(np.linalg.det(planes)) > 1e-9
    planes[~meet] = np.eye(3)
    corners = np.linalg.solve(planes, offsets[:, _TRIPLES][..., None])[..., 0]
    outside = (corners @ normals.transpose(0, 2, 1) - offsets[:, None]).max(axis=2)
    weights = (meet & (outside < 0.1 * TOUCH)).astype(np.float64)
    return np.einsum("nc,ncx->nx", weights, corners) / weights.sum(axis=1)[:, None]
