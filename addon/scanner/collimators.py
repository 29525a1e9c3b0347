"""Appearance of modules: meshes of their parts and of the ROI sphere, and their colours."""

import bmesh
import bpy
import numpy as np

from ...core.geometry import part_colors
from ...core.geometry.module_parts import Solid, check_watertight
from ..blender import compat

# The material's name, and its colour and gloss, by `Object.mphdrr_module.part`. Exported solids look the same.
LOOKS = {kind.upper(): (f"mphDRR {kind}", look) for kind, look in part_colors.LOOKS.items()}
PARTS = tuple(LOOKS)
"""The kinds of parts that are children of a module's camera."""
LOOKS["ROI"] = "mphDRR ROI", part_colors.Look((0.25, 0.62, 1.0, 0.12), metallic=0.0, roughness=0.5)  # pale blue
LOOKS["ARROWS"] = "mphDRR arrows", part_colors.Look((1.0, 0.3, 0.0, 1.0), metallic=0.0, roughness=0.6)  # orange


def new_mesh(name: str, solid: Solid, material: bpy.types.Material) -> bpy.types.Mesh:
    """Return a new mesh datablock of a solid, checked to be watertight, with one material."""
    check_watertight(solid)
    mesh = bpy.data.meshes.new(name)
    reshape_mesh(mesh, solid)
    mesh.materials.append(material)
    return mesh


def has_shape(mesh: bpy.types.Mesh, solid: Solid) -> bool:
    """Return whether the points of a mesh are those of `solid`."""
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", points)
    return np.array_equal(points, solid[0].astype(np.float32).ravel())


def reshape_mesh(mesh: bpy.types.Mesh, solid: Solid) -> None:
    """Give a mesh the shape of `solid`, in place: undo needs the same datablock."""
    vertices, faces = solid
    if len(mesh.vertices) == len(vertices) and len(mesh.polygons) == len(faces):
        # Setting the attribute is 30 times as fast as setting `vertices`.
        mesh.attributes["position"].data.foreach_set("vector", vertices.astype(np.float32).ravel())
        mesh.update()
    else:  # the mesh is new, or the user has edited it
        mesh.clear_geometry()
        mesh.from_pydata(vertices, [], faces)
        mesh.shade_flat()


def new_sphere(name: str, radius: float, material: bpy.types.Material) -> bpy.types.Mesh:
    """Return a new smooth sphere of `radius` mm around the origin."""
    mesh = bpy.data.meshes.new(name)
    edit_mesh = bmesh.new()
    bmesh.ops.create_uvsphere(edit_mesh, u_segments=64, v_segments=32, radius=radius)
    edit_mesh.to_mesh(mesh)
    edit_mesh.free()
    mesh.shade_smooth()
    mesh.materials.append(material)
    return mesh


def resize_sphere(mesh: bpy.types.Mesh, radius: float) -> None:
    """Give a sphere around the origin another radius, mm, in place."""
    if len(mesh.vertices) and abs(mesh.vertices[0].co.length - radius) <= 1e-6 * radius:
        return  # in nearly all calls
    points = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", points)
    norms = np.linalg.norm(points.reshape(-1, 3), axis=1)
    if len(norms) and norms.min() > 0 and abs(norms.max() - radius) > 1e-6 * radius:
        mesh.vertices.foreach_set("co", (points.reshape(-1, 3) * (radius / norms)[:, None]).astype(np.float32).ravel())
        mesh.update()


def part_material(part: str) -> bpy.types.Material:
    """Return the material of a scanner's parts of one kind; an existing one keeps the user's changes."""
    name, look = LOOKS[part]
    if (material := bpy.data.materials.get(name)) is not None:
        return material
    material, shader = compat.surface_material(name, "ShaderNodeBsdfPrincipled")
    # These show in Solid view; the shader's inputs show in renders.
    material.diffuse_color, material.metallic, material.roughness = look.color, 0.3 * look.metallic, look.roughness
    if look.color[3] < 1.0:
        material.surface_render_method = "BLENDED"
    shader.inputs["Base Color"].default_value = (*look.color[:3], 1.0)
    shader.inputs["Metallic"].default_value = look.metallic
    shader.inputs["Roughness"].default_value = look.roughness
    shader.inputs["Alpha"].default_value = look.color[3]
    if part == "ROI":  # only the rim of the sphere is visible
        tree = material.node_tree
        weight = compat.add_node(tree, "ShaderNodeLayerWeight", (-520, 0), {"Blend": 0.25})
        scaled = compat.add_math(tree, "MULTIPLY", (-260, 0), weight.outputs["Facing"], 0.35)
        tree.links.new(scaled, shader.inputs["Alpha"])
    return material
