"""Arrows from where modules are nominally to where they were found, as one object of the scanner."""

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.geometry.frames import module_frames
from ...core.geometry.module_parts import Solid
from ..blender import ids, objects
from . import collimators

_SIDES = 12
_RADII = np.array([0.0, 1.5, 1.5, 4.0, 0.0])  # mm, of the circles from the start to the tip
_HEAD = 12.0  # mm, at most half of the arrow
_LONGEST = 50.0  # mm, about


def show(
    collection: bpy.types.Collection, starts: NDArray[np.float64], ends: NDArray[np.float64], factor: float = 0.0
) -> float:
    """Show arrows `factor` times as long as the ways from `starts` to `ends` (M, 3), mm, in place of those of before.

    The factor 0 makes the longest about 50 mm. Returns the factor; 0 where there is no way, and so no arrow.
    """
    objects.remove_objects([item for item in collection.objects if item.mphdrr_module.part == "ARROWS"])
    ways = ends - starts
    lengths = np.linalg.norm(ways, axis=1)
    if not lengths.any():
        return 0.0
    factor = factor or float(f"{_LONGEST / lengths.max():.1g}")
    mesh = bpy.data.meshes.new(ids.ARROWS)
    collimators.reshape_mesh(mesh, _solid(starts[lengths > 0], factor * ways[lengths > 0]))
    mesh.materials.append(collimators.part_material("ARROWS"))
    item = bpy.data.objects.new(ids.ARROWS, mesh)
    item.mphdrr_module.part, item.show_in_front, item.visible_shadow = "ARROWS", True, False
    collection.objects.link(item)
    return factor


def _solid(starts: NDArray[np.float64], ways: NDArray[np.float64]) -> Solid:
    """Points and faces of arrows: circles one after the other, of which the first and the last are points."""
    lengths = np.linalg.norm(ways, axis=1)
    neck, zero = lengths - np.minimum(_HEAD, lengths / 2), np.zeros_like(lengths)
    along = np.stack([zero, zero, neck, neck, lengths], axis=1)
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    u, v, k = module_frames(-ways).swapaxes(0, 1)[:, :, None]
    circles = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
    middles = starts[:, None] + along[..., None] * k
    points = middles[:, :, None] + _RADII[:, None, None] * circles[:, None]
    ring = np.arange(len(_RADII) * _SIDES, dtype=np.int32).reshape(-1, _SIDES)
    after = np.roll(ring, -1, axis=1)
    sides = np.stack([ring[:-1], after[:-1], after[1:], ring[1:]], axis=-1).reshape(-1, 4)
    arrows = ring.size * np.arange(len(ways), dtype=np.int32)
    return points.reshape(-1, 3), (arrows[:, None, None] + sides).reshape(-1, 4)
