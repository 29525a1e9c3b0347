"""Outlines of phantoms: the surfaces of their shapes, as wires."""

from __future__ import annotations

from collections.abc import Sequence

import bmesh
import bpy
import numpy as np

from ..core.phantoms.phantom import PhantomMesh
from ..core.volumes.meshes.mesh import Mesh
from . import meshes

_KEY = "mphdrr_outline"  # custom property of the mesh object


def of(item: bpy.types.Object) -> bpy.types.Object | None:
    """A phantom's outline, if it has one."""
    return next((child for child in item.children if _KEY in child), None)


def show(item: bpy.types.Object, parts: Sequence[PhantomMesh]) -> None:
    """Give a phantom an outline of these surfaces, in its own frame, in place of the one it has."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    remove(item)
    collection = item.users_collection[0] if item.users_collection else bpy.context.scene.collection
    outline = meshes.add_mesh(Mesh(vertices, faces), f"{item.name} outline", np.eye(4), collection)
    _merge_flat_faces(outline.data)
    outline[_KEY] = True
    outline.display_type = "WIRE"
    outline.hide_render = outline.hide_select = True
    outline.parent = item


def remove(item: bpy.types.Object) -> None:
    """Remove a phantom's outline, if it has one."""
    outline = of(item)
    if outline is not None:
        mesh = outline.data
        bpy.data.objects.remove(outline)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)


def _merge_flat_faces(mesh: bpy.types.Mesh) -> None:
    """Remove edges inside flat faces, which would fill the picture with wires."""
    shape = bmesh.new()
    try:
        shape.from_mesh(mesh)
        bmesh.ops.dissolve_limit(shape, angle_limit=0.01, verts=shape.verts, edges=shape.edges)
        shape.to_mesh(mesh)
    finally:
        shape.free()
