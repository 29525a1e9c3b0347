"""Conversion between the scene's mesh objects and core's meshes, and jobs between meshes and volumes."""

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...core import Progress, memory, volume_to_mesh, voxelize_mesh
from ...core.errors import InputError, naming
from ...core.geometry.frames import moved
from ...core.geometry.grid import grid_around
from ...core.volumes.meshes.mesh import Mesh, require_closed
from ...core.volumes.volume import UNITS, Volume
from ..blender import jobs, objects
from . import stored_volumes, volume_materials, volumes

_BYTES_PER_VOXEL = 40.0  # memory needed while the volume is made and put into the scene


def voxelize_job(
    items: Sequence[bpy.types.Object],
    value: float = 100.0,
    quantity: str = "activity",
    voxels: int = 128,
    voxel_size: float = 0.0,
    name: str = "",
) -> jobs.Job:
    """Return the job that makes a volume of closed mesh objects, modifiers and instances included.

    A voxel at a surface holds the value times the fraction of the voxel that is covered. Later items replace earlier ones
    where they overlap. The `value` inside is in the unit of the `quantity`, "activity" or "mu"; an object's custom property
    of that name replaces it. `voxels` is their number along the longest side; a `voxel_size` in mm, if not 0, replaces it.
    The volume's name is by default made from the first mesh's.
    """
    if not items:
        raise InputError("no mesh object is selected: select closed meshes first")
    meshes_of_items = evaluated_meshes(items, bpy.context.evaluated_depsgraph_get())
    values = [float(item.get(quantity, value)) for item, meshes in meshes_of_items for _ in meshes]
    solids = [mesh for _, meshes in meshes_of_items for mesh in meshes]
    vertices = np.concatenate([solid.vertices for solid in solids])
    spacing = voxel_size or float(np.ptp(vertices, axis=0).max()) / max(1, voxels - 2)
    grid = grid_around(vertices, spacing)
    shape = " x ".join(map(str, grid.shape))
    memory.require(_BYTES_PER_VOXEL * grid.n_voxels, f"a volume of {shape} voxels")
    name = name or f"{items[0].name} {quantity}"
    provenance = {"meshes": [item.name for item in items], "values": values}

    def make(progress: Progress) -> Volume:
        """Return the volume of the meshes."""
        return voxelize_mesh(solids, grid, values, quantity, progress)

    def finish(item: bpy.types.Object, stored: stored_volumes.StoredVolume) -> str:
        """Return the line to report: the new volume's voxels and its total."""
        content = float(stored.volume.array.sum(dtype=np.float64)) * grid.voxel_volume
        total = f"{content * 1e-3:.4g} kBq" if quantity == "activity" else f"{content:.4g} {UNITS[quantity]} mm^3"
        return f"Added {name!r}: {shape} voxels of {grid.spacing[0]:.3g} mm, {total} in all"

    return volumes.add_volume_job("Voxelizing meshes", make, name, finish, provenance=provenance, sources=items)


def mesh_job(item: bpy.types.Object, level: float | None = None) -> jobs.Job:
    """Return the job that makes a closed mesh of a volume's isosurface at `level`, in the unit that the window shows.

    The default level is halfway between the value outside and the largest.
    """
    read, pose, name = volumes.reader(item), volumes.pose_of_object(item), f"{item.name} surface"
    if level is not None:
        level /= volume_materials.display_unit(volumes.quantity_of(item))[1]

    def work(progress: Progress) -> Mesh:
        """Return the mesh of the isosurface."""
        return volume_to_mesh(read(), level, progress)

    def finish(mesh: Mesh) -> str:
        """Add the mesh to the scene, and return the line to report."""
        add_mesh(mesh, name, pose, bpy.context.collection)
        return f"Added {name!r}: {len(mesh.faces)} triangles around {abs(mesh.volume):.4g} mm^3"

    return jobs.Job("Mesh from volume", work, finish)


def evaluated_meshes(
    items: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph
) -> list[tuple[bpy.types.Object, list[Mesh]]]:
    """Return objects with their meshes as Blender shows them, in world mm: modifiers and instances included.

    `InputError` names an object without faces, or with an open mesh.
    """
    meshes: dict[bpy.types.Object, list[Mesh]] = {item: [] for item in items}
    for item in items:
        if item.type == "MESH" and (not item.is_instancer or item.show_instancer_for_viewport):
            meshes[item] += _closed_meshes(item.evaluated_get(depsgraph), objects.world_matrix(item), item.name)
    for instance in depsgraph.object_instances:
        owner = instance.parent.original if instance.is_instance and instance.parent else None
        if owner is not None and owner in meshes and instance.object.type == "MESH":
            meshes[owner] += _closed_meshes(instance.object, np.array(instance.matrix_world, np.float64), owner.name)
    for item, item_meshes in meshes.items():
        if not item_meshes:
            raise InputError(f"{item.name!r}: the mesh has no faces")
    return list(meshes.items())


def _closed_meshes(evaluated: bpy.types.Object, pose: NDArray[np.float64], name: str) -> list[Mesh]:
    """Return the mesh of an evaluated object at a pose (4, 4), mm, in a list; it is empty for an object without faces."""
    mesh = evaluated.to_mesh()
    try:
        mesh.calc_loop_triangles()
        points = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", points.ravel())
        faces = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.loop_triangles.foreach_get("vertices", faces.ravel())
    finally:
        evaluated.to_mesh_clear()
    if not len(faces):
        return []
    if np.linalg.det(pose[:3, :3]) < 0:  # a mirrored object shows the other side of its faces
        faces = faces[:, ::-1]
    with naming(repr(name)):
        result = Mesh(moved(pose, points.astype(np.float64)), faces.astype(np.int64))
        require_closed(result)
    return [result]


def add_mesh(mesh: Mesh, name: str, pose: NDArray[np.float64], collection: bpy.types.Collection) -> bpy.types.Object:
    """Return a new object for a mesh in world mm, with its origin and axes at the world-from-object matrix `pose` (4, 4)."""
    data = bpy.data.meshes.new(name)
    vertices = moved(np.linalg.inv(pose), mesh.vertices)
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
