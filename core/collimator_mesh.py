"""Solid shapes of a module as vertices and faces: the collimator with its aperture plate, and the crystal.

Everything is in the module's camera space, mm: the pinhole at the origin, X = -u, Y = v, Z = -k, so that the
collimator lies behind the pinhole at Z = s from 0 to l and the crystal at Z from l to l + Td.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

Solid = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Vertices (V, 3), mm, and quads (F, 4), counter-clockwise as seen from outside."""

_N = 32  # points on a ring; a multiple of 8, so that the squares have points at their corners


def collimator_solid(
    pinhole_diameter: float,
    collimator_length: float,
    detector_side: float,
    plate_thickness: float,
    wall_thickness: float,
) -> Solid:
    """A square pyramid from the pinhole to the crystal, with a plate in front that has a round hole.

    The inside at distance s behind the pinhole is a square of half-width ``d/2 + (Ld - d)/2 * s/l``: the pyramid
    that the crystal sees through the hole. The outside is wider by the wall's thickness. The plate's front is at
    s = 0.

    One closed surface of genus 1: six rings of points (hole front, hole back, inner square at the plate, inner
    square at the crystal, outer square at the crystal, outer square in front) joined by quads, the last ring to
    the first.

    Raises
    ------
    InputError
        The plate or the wall has no thickness, or the plate is as thick as the collimator is long.
    """
    d, side, plate, wall = pinhole_diameter, detector_side, plate_thickness, wall_thickness
    if not 0 < plate < collimator_length:
        raise InputError(
            f"aperture plate: expected more than 0 and less than the collimator's {collimator_length:g} mm, got {plate:g} mm"
        )
    if not wall > 0:
        raise InputError(f"collimator wall: expected more than 0 mm, got {wall:g} mm")
    if not 0 < d < side:
        raise InputError(
            f"pinhole diameter: expected more than 0 and less than the crystal's {side:g} mm, got {d:g} mm"
        )
    angle = 2 * np.pi * np.arange(_N) / _N
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    square = circle / np.abs(circle).max(axis=1, keepdims=True)  # half-width 1, at the same angles
    inside = d / 2 + (side - d) / 2 * plate / collimator_length
    rings = (
        (circle * d / 2, 0.0),
        (circle * d / 2, plate),
        (square * inside, plate),
        (square * side / 2, collimator_length),
        (square * (side / 2 + wall), collimator_length),
        (square * (d / 2 + wall), 0.0),
    )
    vertices = np.concatenate([np.column_stack([xy, np.full(_N, z)]) for xy, z in rings])
    ring, point = np.divmod(np.arange(len(rings) * _N), _N)
    following_ring, following_point = (ring + 1) % len(rings), (point + 1) % _N
    faces = np.stack(
        [
            ring * _N + point,
            following_ring * _N + point,
            following_ring * _N + following_point,
            ring * _N + following_point,
        ],
        axis=1,
    )
    return vertices, faces.astype(np.int32)


def crystal_solid(collimator_length: float, detector_side: float, detector_thickness: float) -> Solid:
    """The crystal: a box of side Ld from s = l to s = l + Td."""
    h = detector_side / 2
    front, back = collimator_length, collimator_length + detector_thickness
    vertices = np.array([[x, y, z] for z in (front, back) for x, y in ((-h, -h), (h, -h), (h, h), (-h, h))])
    faces = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    return vertices, np.array(faces, dtype=np.int32)


def module_solids(
    pinhole_diameter: float,
    collimator_length: float,
    detector_side: float,
    detector_thickness: float,
    plate_thickness: float,
    wall_thickness: float,
) -> tuple[Solid, Solid]:
    """Collimator and crystal of a module; raises as `collimator_solid` does."""
    return (
        collimator_solid(pinhole_diameter, collimator_length, detector_side, plate_thickness, wall_thickness),
        crystal_solid(collimator_length, detector_side, detector_thickness),
    )


def signed_volume(solid: Solid) -> float:
    """Enclosed volume, mm^3: positive where the faces look outwards."""
    vertices, faces = solid
    a, b, c, d = (vertices[faces[:, i]] for i in range(4))
    return float((np.einsum("ij,ij->i", a, np.cross(b, c)) + np.einsum("ij,ij->i", a, np.cross(c, d))).sum() / 6)


def check_watertight(solid: Solid) -> None:
    """Refuse a surface that is not closed and consistently oriented, or that looks inwards.

    Raises
    ------
    InputError
        An edge does not belong to exactly two faces that run along it in opposite directions, or the volume
        is not positive.
    """
    vertices, faces = solid
    starts, ends = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    n = len(vertices)
    forward, backward = np.sort(starts * n + ends), np.sort(ends * n + starts)
    if np.any(np.diff(forward) == 0) or not np.array_equal(forward, backward):
        raise InputError("collimator mesh: it is not closed (an edge is not shared by exactly two faces)")
    volume = signed_volume(solid)
    if not volume > 0:
        raise InputError(f"collimator mesh: its volume is {volume:g} mm^3, expected more than 0")
