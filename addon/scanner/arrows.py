"""Arrows from where modules are nominally to where they were found, as one object of the scanner."""

import bpy
import numpy as np
from numpy.typing import NDArray

from ..blender import ids, objects
from . import collimators

_RADII = 1.5, 1.5, 4.0, 0.0  # mm: of the shaft's ends, of the head's end and of the tip
_HEAD = 12.0  # mm long, at most half of the arrow
_LONGEST = 50.0  # mm, about


def show(
    collection: bpy.types.Collection, starts: NDArray[np.float64], ends: NDArray[np.float64], factor: float = 0.0
) -> float:
    """Show arrows `factor` times as long as the ways from `starts` to `ends` (M, 3), mm, in place of those of before.

    The factor 0 makes the longest about 50 mm. Returns the factor; 0 where there is no way, and so no arrow.
    """
    objects.remove_objects([item for item in collection.objects if item.mphdrr_module.part == "ARROWS"])
    longest = float(np.linalg.norm(ends - starts, axis=1).max())
    if not longest:
        return 0.0
    factor = factor or float(f"{_LONGEST / longest:.1g}")
    curve = bpy.data.curves.new(ids.ARROWS, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.use_fill_caps = "3D", 1.0, True  # mm, times each point's radius
    curve.materials.append(collimators.part_material("ARROWS"))
    moved = (ends != starts).any(axis=1)
    for start, way in zip(starts[moved], factor * (ends - starts)[moved], strict=True):
        neck = 1 - min(_HEAD / float(np.linalg.norm(way)), 0.5)
        points = curve.splines.new("POLY").points
        points.add(len(_RADII) - 1)
        for point, along, radius in zip(points, (0.0, neck, neck + 1e-3, 1.0), _RADII, strict=True):
            point.co, point.radius = (*(start + along * way), 1.0), radius
    item = bpy.data.objects.new(ids.ARROWS, curve)
    item.mphdrr_module.part, item.show_in_front, item.visible_shadow = "ARROWS", True, False
    collection.objects.link(item)
    return factor
