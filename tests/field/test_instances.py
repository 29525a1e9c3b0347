"""Voxelize Meshes takes what Blender shows: instances of geometry nodes, of vertices and faces, and of collections.

https://github.com/KhronosGroup/glTF-Blender-IO/issues/1537 and https://github.com/KhronosGroup/glTF-Blender-IO/issues/2317.
"""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from mphdrr.addon.volumes import volumes  # noqa: E402

from ..blender.conftest import registered, scene, select  # noqa: E402

__all__ = ["registered", "scene"]  # fixtures


def content(*items) -> float:
    """Return the mm^3 of the volume that the command makes of these objects, with a value of 1."""
    select(*items)
    assert bpy.ops.mphdrr.voxelize_objects(value=1.0, voxels=64) == {"FINISHED"}
    volume = volumes.volume_from_object(volumes.volume_objects(bpy.context.scene)[-1])
    return float(volume.array.sum(dtype=np.float64)) * volume.grid.voxel_volume


@pytest.fixture(autouse=True)
def nothing_else(scene):
    bpy.data.batch_remove(list(bpy.data.objects))


def cube(size: float, location=(0.0, 0.0, 0.0)):
    bpy.ops.mesh.primitive_cube_add(size=size, location=location)
    return bpy.context.object


@pytest.mark.parametrize("is_joined", [True, False])
def test_instances_of_geometry_nodes(is_joined):
    item = cube(20.0)
    tree = bpy.data.node_groups.new("corners", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    kinds = "NodeGroupInput", "GeometryNodeInstanceOnPoints", "GeometryNodeMeshCube", "GeometryNodeJoinGeometry"
    start, points, small, join = map(tree.nodes.new, kinds)
    end = tree.nodes.new("NodeGroupOutput")
    small.inputs["Size"].default_value = (4.0, 4.0, 4.0)
    tree.links.new(start.outputs[0], points.inputs["Points"])
    tree.links.new(small.outputs["Mesh"], points.inputs["Instance"])
    tree.links.new(points.outputs[0], join.inputs[0])
    if is_joined:
        tree.links.new(start.outputs[0], join.inputs[0])
    tree.links.new(join.outputs[0], end.inputs[0])
    item.modifiers.new("corners", "NODES").node_group = tree
    assert content(item) == pytest.approx(20**3 + 8 * (4**3 - 2**3) if is_joined else 8 * 4**3, rel=2e-3)


@pytest.mark.parametrize("kind, number", [("VERTS", 8), ("FACES", 6)])
@pytest.mark.parametrize("is_shown", [True, False])
def test_instances_on_vertices_and_faces(kind, number, is_shown):
    carrier = cube(20.0)
    child = cube(4.0)
    child.parent = carrier
    carrier.instance_type, carrier.show_instancer_for_viewport = kind, is_shown
    child.select_set(False)
    inside = {"VERTS": 2.0**3, "FACES": 4.0 * 4.0 * 2.0}[kind]
    expected = number * (4**3 - (inside if is_shown else 0.0)) + (20**3 if is_shown else 0.0)
    assert content(carrier) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 1, 1), (-1, 1, 0.5)])
def test_instanced_collections(scale):
    collection = bpy.data.collections.new("Pair")
    for location in ((0, 0, 0), (15, 0, 0)):
        item = cube(6.0, location)
        bpy.context.collection.objects.unlink(item)
        collection.objects.link(item)
    bpy.ops.object.collection_instance_add(collection=collection.name, location=(3, 4, 5), rotation=(0.2, 0.4, 0.1))
    empty = bpy.context.object
    empty.scale = scale
    assert content(empty) == pytest.approx(2 * 6**3 * abs(np.prod(scale)), rel=3e-3)
