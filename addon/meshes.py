"""Mesh objects of the scene <-> core meshes."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.volumes.meshes.mesh import Mesh, require_closed
from .cameras import world_matrix


def meshes_of(items: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph) -> list[Mesh]:
    """What objects look like, modifiers and all, in world mm.

    Raises
    ------
    InputError
        One has no faces, or its mesh is open: it names the object, and where.
    """
    meshes = []
    for item in items:
        try:
            meshes.append(_mesh_of(item, depsgraph))
            require_closed(meshes[-1])
        except InputError as error:
            raise InputError(f"{item.name!r}: {error}") from None
    return meshes


def _mesh_of(item: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Mesh:
    evaluated = item.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()
    try:
        mesh.calc_loop_triangles()
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("vertices", corners)
    finally:
        evaluated.to_mesh_clear()
    pose = world_matrix(item)
    faces = corners.reshape(-1, 3).astype(np.int64)
    if np.linalg.det(pose[:3, :3]) < 0:  # a mirrored object shows the other side of its faces
        faces = faces[:, ::-1]
    return Mesh(points.reshape(-1, 3).astype(np.float64) @ pose[:3, :3].T + pose[:3, 3], faces)


def add_mesh(mesh: Mesh, name: str, pose: NDArray[np.float64], collection: bpy.types.Collection) -> bpy.types.Object:
    """A mesh object with its origin and axes at world-from-object `pose` (4, 4)."""
    from mathutils import Matrix

    back = np.linalg.inv(pose)
    data = bpy.data.meshes.new(name)
    vertices = mesh.vertices @ back[:3, :3].T + back[:3, 3]
    faces = mesh.faces if np.linalg.det(pose[:3, :3]) > 0 else mesh.faces[:, ::-1]
    data.vertices.add(len(vertices))
    data.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    data.loops.add(faces.size)
    data.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    data.polygons.add(len(faces))
    data.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    data.update(calc_edges=True)
    data.shade_smooth()
    item = bpy.data.objects.new(name, data)
    collection.objects.link(item)
    item.matrix_world = Matrix(pose)
    return item
