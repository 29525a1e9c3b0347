"""Differences between Blender versions; the only file that looks at `bpy.app.version`."""

import bpy

# Voxel index i of an OpenVDB grid is drawn over [i, i + 1] in 4.5, centred on i in 5.0 and later. Files that a scene draws
# have this (in voxels) added to their transforms.
VDB_CENTER_SHIFT = 0.0 if bpy.app.version >= (5, 0, 0) else -0.5


def enable_nodes(material: bpy.types.Material) -> None:
    """Give a new material its node tree; since 5.0 every material has one."""
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
