"""Solids of modules, collimators with their aperture plates and crystals, for display, checks and files.

The coordinates of a solid are those of the module's camera space, mm: the pinhole at the origin, X = -u, Y = v, Z = -k. So
the crystal reaches from Z = l to l + Td, and the collimator stands in front of it, around the pinhole.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..errors import InputError
from ..validation import freeze
from .collimator import Collimator
from .frames import moved
from .part_colors import PartKind

Solid = tuple[Floats, NDArray[np.int32]]
"""Vertices (V, 3), mm, and quads (F, 4), counter-clockwise seen from outside."""

# Number of points on a ring: a multiple of 8, so that squares have points at their corners. The polygon is inscribed in the
# hole's circle: 99.84 % of the area is open.
_N = 64
_ANGLE = 2 * np.pi * np.arange(_N) / _N
_CIRCLE = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)
_SQUARE = _CIRCLE / np.abs(_CIRCLE).max(axis=1, keepdims=True)  # half-width 1, at the same angles
_OUTLINES = {"circle": _CIRCLE, "square": _SQUARE}


_FACES = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
BOX_FACES = freeze(np.array(_FACES, np.int32))
"""Quads (6, 4) of a box whose corners 0 to 3 go around one end, and 4 to 7 around the other."""


@dataclass(frozen=True, eq=False)
class ModulePart:
    """Solid part of a module: its collimator with the aperture plate, or its crystal."""

    number: int  # number of the module
    kind: PartKind
    name: str  # name such as "Module 07 collimator", which sorts like the module's number
    solid: Solid  # surface in the module's camera space, mm
    pose: Floats  # (4, 4), world from camera space, mm

    @property
    def vertices(self) -> Floats:
        """Vertices (V, 3) of the surface, world mm."""
        return moved(self.pose, self.solid[0])

    @property
    def triangles(self) -> NDArray[np.int32]:
        """Triangles (F, 3) of the surface as indices of vertices, counter-clockwise seen from outside."""
        return self.solid[1][:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def collimator_solid(collimator: Collimator) -> Solid:
    """Return the surface of a collimator, one closed surface of genus 1.

    Rings of points run along the hole from the plate's front to its back, along the channel to the crystal, and along the
    outside back to the front; quads join each ring to the next and the last to the first.
    """
    rings = collimator.rings
    vertices = np.empty((len(rings), _N, 3))
    for ring, (outline, half_width, depth) in zip(vertices, rings, strict=True):
        ring[:, :2], ring[:, 2] = _OUTLINES[outline] * half_width, depth
    return vertices.reshape(-1, 3), _ring_faces(len(rings))


@lru_cache
def _ring_faces(n: int) -> NDArray[np.int32]:
    """Return the quads that join each of `n` rings of `_N` points to the next and the last to the first."""
    ring, point = np.divmod(np.arange(n * _N), _N)
    following_ring, following_point = (ring + 1) % n, (point + 1) % _N
    corners = (ring, point), (following_ring, point), (following_ring, following_point), (ring, following_point)
    return freeze(np.stack([i * _N + j for i, j in corners], axis=1).astype(np.int32))


def crystal_solid(collimator_length: float, detector_side: float, detector_thickness: float) -> Solid:
    """Return the surface of a crystal, a box of side Ld from depth l to l + Td; arguments in mm."""
    half = detector_side / 2
    corners = (-half, -half), (half, -half), (half, half), (-half, half)
    front, back = collimator_length, collimator_length + detector_thickness
    return np.array([[x, y, z] for z in (front, back) for x, y in corners]), BOX_FACES


def surface_fault(solid: Solid) -> str | None:
    """Return what is wrong with a surface, for messages; None if it is closed, consistently oriented and not inside out."""
    vertices, faces = solid
    starts, ends = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    n = len(vertices)
    forward, backward = np.sort(starts * n + ends), np.sort(ends * n + starts)
    if np.any(np.diff(forward) == 0) or not np.array_equal(forward, backward):
        return "is not closed (an edge is not shared by exactly two faces)"
    a, b, c, d = (vertices[faces[:, i]] for i in range(4))
    volume = (np.einsum("ij,ij->i", a, np.cross(b, c)) + np.einsum("ij,ij->i", a, np.cross(c, d))).sum() / 6
    return None if volume > 0 else f"has a volume of {volume:g} mm^3, expected more than 0"


def check_watertight(solid: Solid) -> None:
    """Raise `InputError` unless a collimator's surface is closed, consistently oriented and not inside out."""
    if fault := surface_fault(solid):
        raise InputError(f"collimator mesh: it {fault}")
