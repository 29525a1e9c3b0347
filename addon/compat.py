"""Differences between Blender versions; the only file that looks at `bpy.app.version`."""

import bpy

# Voxel index i of an OpenVDB grid is drawn over [i, i + 1] in 4.5, centred on i in 5.0 and later. Files that a scene draws
# have this (in voxels) added to their transforms.
VDB_CENTER_SHIFT = 0.0 if bpy.app.version >= (5, 0, 0) else -0.5


def blank_material(name: str) -> bpy.types.Material:
    """A new material with an empty node tree."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0, 0):  # since then every material has a node tree
        material.use_nodes = True
    material.node_tree.nodes.clear()  # 4.5 begins with a volume's nodes where a volume is active
    return material


def surface_material(name: str, kind: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """A new material whose surface is a shader of that kind, and the shader."""
    material = blank_material(name)
    tree = material.node_tree
    shader, output = tree.nodes.new(kind), tree.nodes.new("ShaderNodeOutputMaterial")
    output.location = (300.0, 0.0)
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    return material, shader
