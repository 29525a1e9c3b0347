"""Differences between Blender versions; the only file that looks at `bpy.app.version`."""

from typing import Any

import bpy

# Voxel index i of an OpenVDB grid is drawn over [i, i + 1] in 4.5, centred on i in 5.0 and later. Files that a scene draws
# have this (in voxels) added to their transforms.
VDB_CENTER_SHIFT = 0.0 if bpy.app.version >= (5, 0, 0) else -0.5


def use_nodes(data: bpy.types.Material | bpy.types.World) -> None:
    """Give a material or a world its node tree."""
    if bpy.app.version < (5, 0, 0):  # since then each has one
        data.use_nodes = True


def blank_material(name: str) -> bpy.types.Material:
    """A new material with an empty node tree."""
    material = bpy.data.materials.new(name)
    use_nodes(material)
    material.node_tree.nodes.clear()  # 4.5 begins with a volume's nodes where a volume is active
    return material


Place = tuple[float, float]
"""Where a node is in its editor."""


def add_node(
    tree: bpy.types.NodeTree, kind: str, place: Place, inputs: dict[Any, Any] | None = None, **settings: Any
) -> bpy.types.Node:
    """Add a node to a tree, its `inputs` linked to outputs of other nodes or set to values."""
    node = tree.nodes.new(kind)
    node.location = place
    for name, value in settings.items():
        setattr(node, name, value)
    for key, given in (inputs or {}).items():
        if isinstance(given, bpy.types.NodeSocket):
            tree.links.new(given, node.inputs[key])
        else:
            node.inputs[key].default_value = given
    return node


def add_math(
    tree: bpy.types.NodeTree, operation: str, place: Place, one: Any, other: Any, **settings: Any
) -> bpy.types.NodeSocket:
    """Add a node that calculates with two numbers, outputs of other nodes or values; returns its output."""
    return add_node(tree, "ShaderNodeMath", place, {0: one, 1: other}, operation=operation, **settings).outputs[0]


def surface_material(name: str, kind: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """A new material whose surface is a shader of that kind, and the shader."""
    material = blank_material(name)
    shader = add_node(material.node_tree, kind, (0.0, 0.0))
    add_node(material.node_tree, "ShaderNodeOutputMaterial", (300.0, 0.0), {"Surface": shader.outputs[0]})
    return material, shader


def write_films(settings: bpy.types.ImageFormatSettings) -> None:
    """Have renders written as films."""
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "VIDEO"
    settings.file_format = "FFMPEG"
