"""Convex hulls of the modules' parts, frustums with square ends: a filled collimator, or the box of a crystal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays import Floats, Integers
from ..frames import moved, unit_vectors
from ..module_parts import BOX_FACES, ModulePart
from ..part_colors import PartKind

TOUCH = 1e-6
"""Depth, mm, up to which two bodies that penetrate each other are taken to touch only."""

_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_EDGES = np.array([[0, 1], [0, 3], [0, 4], [1, 5], [2, 6], [3, 7]])  # one for each direction


@dataclass(frozen=True, eq=False)
class Hulls:
    """Convex hulls of P parts, world mm. A point x is inside a hull if ``normals @ x <= offsets`` for all its faces."""

    numbers: Integers  # (P,), numbers of the parts' modules
    kinds: tuple[PartKind, ...]  # kind of each part
    vertices: Floats  # (P, 8, 3), corners, mm
    normals: Floats  # (P, 6, 3), outward unit normals of the faces
    offsets: Floats  # (P, 6), of the faces along their normals, mm
    edges: Floats  # (P, 6, 3), unit vectors along the edges, one for each direction
    centers: Floats  # (P, 3), centres of the bounding spheres, mm
    radii: Floats  # (P,), radii of the bounding spheres, mm

    @classmethod
    def from_parts(cls, parts: Sequence[ModulePart]) -> Hulls:
        """Return the convex hulls of `parts`."""
        vertices = np.stack([moved(part.pose, _corners(part.solid[0])) for part in parts])
        a, b, _, d = (vertices[:, BOX_FACES[:, i]] for i in range(4))
        normals = unit_vectors(np.cross(b - a, d - a))
        centers = vertices.mean(axis=1)
        numbers, kinds = np.array([part.number for part in parts]), tuple(part.kind for part in parts)
        offsets = np.einsum("pfx,pfx->pf", normals, a)
        edges = unit_vectors(vertices[:, _EDGES[:, 1]] - vertices[:, _EDGES[:, 0]])
        radii = np.linalg.norm(vertices - centers[:, None], axis=2).max(axis=1)
        return cls(numbers, kinds, vertices, normals, offsets, edges, centers, radii)

    def __len__(self) -> int:
        return len(self.numbers)


def _corners(vertices: Floats) -> Floats:
    """Return the corners (8, 3) of a solid's hull: a box's own, else those of the largest squares at both ends of Z."""
    if len(vertices) == 8:  # a box
        return vertices
    corners = []
    for z in (vertices[:, 2].min(), vertices[:, 2].max()):
        half_width = np.abs(vertices[vertices[:, 2] == z, :2]).max()
        corners.append(np.column_stack([half_width * _SQUARE, np.full(4, z)]))
    return np.concatenate(corners)
