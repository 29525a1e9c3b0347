"""Mesh datablocks of a module: its collimator and crystal, and the sphere that all modules must see."""

from __future__ import annotations

from collections.abc import Callable

import bmesh
import bpy
import numpy as np

from ..core.geometry.collimator_mesh import Solid, check_watertight
from . import compat, ids


def new_mesh(name: str, solid: Solid, material: bpy.types.Material) -> bpy.types.Mesh:
    """A mesh datablock of a solid, checked watertight, with one material."""
    check_watertight(solid)
    mesh = bpy.data.meshes.new(name)
    _fill(mesh, solid)
    mesh.materials.append(material)
    return mesh


def reshape_mesh(mesh: bpy.types.Mesh, solid: Solid) -> None:
    """Give a mesh the shape of `solid`: in place, so that no datablock comes or goes and undo has an easy time."""
    vertices, faces = solid
    if len(mesh.vertices) == len(vertices) and len(mesh.polygons) == len(faces):
        mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
        mesh.update()
    else:  # the user has edited it
        mesh.clear_geometry()
        _fill(mesh, solid)


def _fill(mesh: bpy.types.Mesh, solid: Solid) -> None:
    vertices, faces = solid
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", faces.ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, faces.shape[1], dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_flat()


def new_sphere(name: str, radius: float, material: bpy.types.Material) -> bpy.types.Mesh:
    """A smooth sphere of `radius` mm around the origin."""
    mesh = bpy.data.meshes.new(name)
    shape = bmesh.new()
    bmesh.ops.create_uvsphere(shape, u_segments=64, v_segments=32, radius=radius)
    shape.to_mesh(mesh)
    shape.free()
    mesh.shade_smooth()
    mesh.materials.append(material)
    return mesh


def resize_sphere(mesh: bpy.types.Mesh, radius: float) -> None:
    """Give a sphere around the origin another radius, mm, in place."""
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", points)
    norms = np.linalg.norm(points.reshape(-1, 3), axis=1)
    if len(norms) and norms.min() > 0 and abs(norms.max() - radius) > 1e-6 * radius:
        mesh.vertices.foreach_set("co", (points.reshape(-1, 3) * (radius / norms)[:, None]).astype(np.float32).ravel())
        mesh.update()


def part_material(part: str) -> bpy.types.Material:
    """The material of a scanner's parts of one kind ("COLLIMATOR", "CRYSTAL" or "ROI")."""
    return {"COLLIMATOR": collimator_material, "CRYSTAL": crystal_material, "ROI": roi_material}[part]()


def collimator_material() -> bpy.types.Material:
    """Tungsten: grey metal."""
    return _material(ids.MATERIAL_COLLIMATOR, (0.36, 0.39, 0.43, 1.0), metallic=0.85, roughness=0.42)


def crystal_material() -> bpy.types.Material:
    """Scintillator: amber and clear."""
    return _material(ids.MATERIAL_CRYSTAL, (1.0, 0.48, 0.06, 0.85), roughness=0.12)


def roi_material() -> bpy.types.Material:
    """The ROI's sphere: hardly there but for its rim."""

    def rim(nodes: bpy.types.Nodes, links: bpy.types.NodeLinks, shader: bpy.types.Node) -> None:
        weight = nodes.new("ShaderNodeLayerWeight")
        weight.inputs["Blend"].default_value = 0.25
        weight.location = (-520, 0)
        scale = nodes.new("ShaderNodeMath")
        scale.operation = "MULTIPLY"
        scale.inputs[1].default_value = 0.35
        scale.location = (-260, 0)
        links.new(weight.outputs["Facing"], scale.inputs[0])
        links.new(scale.outputs[0], shader.inputs["Alpha"])

    return _material(ids.MATERIAL_ROI, (0.25, 0.62, 1.0, 0.12), roughness=0.5, extend=rim)


def _material(
    name: str,
    color: tuple[float, float, float, float],
    metallic: float = 0.0,
    roughness: float = 0.5,
    extend: Callable[..., None] | None = None,
) -> bpy.types.Material:
    """The material of that name, made when it is missing: the user's own changes to it stay."""
    material = bpy.data.materials.get(name)
    if material is not None:
        return material
    material = bpy.data.materials.new(name)
    compat.enable_nodes(material)
    material.diffuse_color, material.metallic, material.roughness = (
        color,
        0.3 * metallic,
        roughness,
    )  # in Solid view
    if color[3] < 1.0:
        material.surface_render_method = "BLENDED"
    tree = material.node_tree
    tree.nodes.clear()  # Blender 4.5 begins with a volume's nodes where a volume is active
    shader, output = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("BsdfPrincipled", "OutputMaterial"))
    output.location = (300, 0)
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    for socket, value in (
        ("Base Color", (*color[:3], 1.0)),
        ("Metallic", metallic),
        ("Roughness", roughness),
    ):
        shader.inputs[socket].default_value = value
    shader.inputs["Alpha"].default_value = color[3]
    if extend is not None:
        extend(tree.nodes, tree.links, shader)
    return material
