"""Differences between Blender versions; the only file that looks at `bpy.app.version`."""

from typing import Any

import bpy

# Blender 4.5 draws voxel index i of an OpenVDB grid over [i, i + 1], Blender 5.0 and later centres it on i. The transforms
# of files that a scene draws are shifted by this, voxels.
VDB_CENTER_SHIFT = 0.0 if bpy.app.version >= (5, 0, 0) else -0.5


def use_nodes(data: bpy.types.Material | bpy.types.World) -> None:
    """Give a material or a world its node tree."""
    if bpy.app.version < (5, 0, 0):  # later versions give every material and world one
        data.use_nodes = True


def blank_material(name: str) -> bpy.types.Material:
    """Return a new material with an empty node tree."""
    material = bpy.data.materials.new(name)
    use_nodes(material)
    material.node_tree.nodes.clear()  # Blender 4.5 adds a volume's nodes where a volume is active
    return material


NodeLocation = tuple[float, float]
"""Position (x, y) of a node in its editor."""


def add_node(
    tree: bpy.types.NodeTree, kind: str, location: NodeLocation, inputs: dict[Any, Any] | None = None, **settings: Any
) -> bpy.types.Node:
    """Add a node of type `kind` to a tree and return it; `inputs` are other nodes' outputs to link, or values."""
    node = tree.nodes.new(kind)
    node.location = location
    for name, value in settings.items():
        setattr(node, name, value)
    for key, source in (inputs or {}).items():
        if isinstance(source, bpy.types.NodeSocket):
            tree.links.new(source, node.inputs[key])
        else:
            node.inputs[key].default_value = source
    return node


def add_math(
    tree: bpy.types.NodeTree, operation: str, location: NodeLocation, first: Any, second: Any, **settings: Any
) -> bpy.types.NodeSocket:
    """Add a node that calculates with two numbers, other nodes' outputs or values, and return its output."""
    return add_node(tree, "ShaderNodeMath", location, {0: first, 1: second}, operation=operation, **settings).outputs[0]


def surface_material(name: str, kind: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    """Return a new material whose surface is a shader of type `kind`, and the shader's node."""
    material = blank_material(name)
    shader = add_node(material.node_tree, kind, (0.0, 0.0))
    add_node(material.node_tree, "ShaderNodeOutputMaterial", (300.0, 0.0), {"Surface": shader.outputs[0]})
    return material, shader


def write_films(settings: bpy.types.ImageFormatSettings) -> None:
    """Make renders be written as films."""
    if bpy.app.version >= (5, 0, 0):
        settings.media_type = "VIDEO"
    settings.file_format = "FFMPEG"
