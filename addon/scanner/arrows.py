"""Arrows from the modules' nominal positions to the calibrated ones, as one object of the scanner."""

import bpy
import numpy as np
from numpy.typing import NDArray

from ..blender import ids, objects
from . import collimators

_RADII = 1.5, 1.5, 4.0, 0.0  # mm; of the shaft at both ends, and of the head at its base and tip
_HEAD = 12.0  # length of the head, mm, at most half of the arrow
_LONGEST = 50.0  # approximate length of the longest arrow, mm


def show(
    collection: bpy.types.Collection, starts: NDArray[np.float64], ends: NDArray[np.float64], factor: float = 0.0
) -> float:
    """Show arrows along `factor` * (ends - starts), both (M, 3), mm, in place of earlier ones, and return the factor.

    The factor 0 makes the longest arrow about 50 mm long. Where nothing has moved, there is no arrow and the factor is 0.
    """
    objects.remove_objects([item for item in collection.objects if item.mphdrr_module.part == "ARROWS"])
    if not (longest := float(np.linalg.norm(ends - starts, axis=1).max())):
        return 0.0
    factor = factor or float(f"{_LONGEST / longest:.1g}")
    curve = bpy.data.curves.new(ids.ARROWS, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.use_fill_caps = "3D", 1.0, True  # mm, times each point's radius
    curve.materials.append(collimators.part_material("ARROWS"))
    has_moved = (ends != starts).any(axis=1)
    for start, arrow in zip(starts[has_moved], factor * (ends - starts)[has_moved], strict=True):
        head_start = 1 - min(_HEAD / float(np.linalg.norm(arrow)), 0.5)
        points = curve.splines.new("POLY").points
        points.add(len(_RADII) - 1)
        for point, share, radius in zip(points, (0.0, head_start, head_start + 1e-3, 1.0), _RADII, strict=True):
            point.co, point.radius = (*(start + share * arrow), 1.0), radius
    item = bpy.data.objects.new(ids.ARROWS, curve)
    item.mphdrr_module.part, item.show_in_front, item.visible_shadow = "ARROWS", True, False
    collection.objects.link(item)
    return factor
