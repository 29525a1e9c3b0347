"""Differences between Blender versions; the only file that looks at `bpy.app.version`."""

from __future__ import annotations

import bpy

# The engine was renamed in 5.0.
EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"

# Where voxel index i of an OpenVDB grid is drawn: over [i, i + 1] in 4.5, centred on i in 5.0 and later. Add
# this (in voxels) to the translation of a .vdb transform that means centres.
VDB_CENTER_SHIFT = 0.0 if bpy.app.version >= (5, 0, 0) else -0.5


def enable_nodes(material: bpy.types.Material) -> None:
    """Give a new material its node tree; since 5.0 every material has one."""
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
