"""Convex hulls of the modules' parts. Each is a frustum with square ends: the filled collimator, or the crystal's box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, Integers
from ..frames import moved
from ..module_parts import BOX_FACES, ModulePart
from ..part_colors import PartKind

TOUCH = 1e-6
"""Bodies that penetrate each other by less than this, mm, only touch."""

_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_EDGES = np.array([[0, 1], [0, 3], [0, 4], [1, 5], [2, 6], [3, 7]])  # one for each direction


@dataclass(frozen=True, eq=False)
class Hulls:
    """Convex hulls of P parts, world mm. A point x is inside where ``normals @ x <= offsets`` for all faces."""

    numbers: Integers  # (P,), the modules'
    kinds: tuple[PartKind, ...]
    vertices: Floats  # (P, 8, 3)
    normals: Floats  # (P, 6, 3)
    offsets: Floats  # (P, 6)
    edges: Floats  # (P, 6, 3), unit vectors
    centers: Floats  # (P, 3), of the bounding spheres
    radii: Floats  # (P,)

    @classmethod
    def of(cls, parts: Sequence[ModulePart]) -> Hulls:
        """The hulls of `parts`."""
        vertices = np.stack([moved(part.pose, _corners(part.solid[0])) for part in parts])
        a, b, _, d = (vertices[:, BOX_FACES[:, i]] for i in range(4))
        normals = _unit(np.cross(b - a, d - a))
        centers = vertices.mean(axis=1)
        numbers, kinds = np.array([part.number for part in parts]), tuple(part.kind for part in parts)
        offsets = np.einsum("pfx,pfx->pf", normals, a)
        edges = _unit(vertices[:, _EDGES[:, 1]] - vertices[:, _EDGES[:, 0]])
        radii = np.linalg.norm(vertices - centers[:, None], axis=2).max(axis=1)
        return cls(numbers, kinds, vertices, normals, offsets, edges, centers, radii)

    def __len__(self) -> int:
        return len(self.numbers)


def _corners(vertices: Floats) -> Floats:
    """Corners (8, 3) of the hull: both ends of a solid but a box are squares around Z, of which the outermost count."""
    if len(vertices) == 8:  # a box
        return vertices
    corners = []
    for z in (vertices[:, 2].min(), vertices[:, 2].max()):
        half = np.abs(vertices[vertices[:, 2] == z, :2]).max()
        corners.append(np.column_stack([half * _SQUARE, np.full(4, z)]))
    return np.concatenate(corners)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
