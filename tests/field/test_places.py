"""An object's place is the one that Blender evaluates, whatever its parent: workbooks and volumes take it.

https://github.com/KhronosGroup/glTF-Blender-IO/issues/447 (children elsewhere in exports),
https://github.com/X-Plane/XPlane2Blender/issues/199 (children of bones).
"""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import mphdrr.core as mph  # noqa: E402
from mphdrr.addon.scanner import scanner  # noqa: E402
from mphdrr.addon.volumes import volumes  # noqa: E402

from ..blender.conftest import registered, scene, select  # noqa: E402

__all__ = ["registered", "scene"]  # fixtures


def moved(item):
    item.location, item.rotation_euler, item.scale = (3.0, -4.0, 5.0), (0.1, 0.2, 0.3), (1.0, 1.0, 1.0)
    return item


def curve(with_path: bool):
    bpy.ops.curve.primitive_bezier_circle_add(radius=100)
    item = moved(bpy.context.object)
    item.data.use_path = with_path
    return item, "OBJECT", ""


def bone():
    bpy.ops.object.armature_add()
    return moved(bpy.context.object), "BONE", bpy.context.object.data.bones[0].name


def mesh(kind: str):
    bpy.ops.mesh.primitive_cube_add(size=30.0)
    return moved(bpy.context.object), kind, ""


def lattice():
    bpy.ops.object.add(type="LATTICE")
    return moved(bpy.context.object), "LATTICE", ""


PARENTS = {
    "object": lambda: mesh("OBJECT"), "vertex": lambda: mesh("VERTEX"), "three vertices": lambda: mesh("VERTEX_3"),
    "bone": bone, "lattice": lattice, "curve": lambda: curve(False), "curve with path": lambda: curve(True),
}  # fmt: skip


def parent(item, name: str) -> None:
    """Give an object a parent of some kind that has been moved, and let Blender evaluate both."""
    item.parent, item.parent_type, item.parent_bone = PARENTS[name]()
    if item.parent_type == "VERTEX_3":
        item.parent_vertices = (0, 1, 2)
    if item.parent_type != "VERTEX_3":
        item.parent.delta_location = (0.5, 0.25, 0.125)
    bpy.context.view_layer.update()


@pytest.mark.parametrize("name", PARENTS)
def test_a_module_is_where_blender_has_it(scene, tmp_path, name):
    system = mph.PinholeSystem(np.array([[200.0, 0, 0], [0, 210.0, 5.0]]), 2.0, 60.0, 40.0, 9.0, 75.0)
    collection = scanner.build_scanner(scene, system, "Pair")
    camera = scanner.modules(collection)[0]
    parent(camera, name)
    path = tmp_path / "w.xlsx"
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    np.testing.assert_allclose(mph.read_system(path).centers[0], camera.matrix_world.translation, atol=2e-4)
    np.testing.assert_allclose(mph.read_system(path).centers[1], system.centers[1], atol=1e-9)


@pytest.mark.parametrize("name", PARENTS)
def test_a_volume_is_where_blender_has_it(scene, name):
    item = volumes.add_volume(mph.Volume(np.ones((3, 4, 5), np.float32), mph.Grid.centered((3, 4, 5), 2.0)), "Box")
    local = volumes.volume_from_object(item).grid.affine
    parent(item, name)
    expected = np.array(item.matrix_world) @ local
    np.testing.assert_allclose(volumes.volume_from_object(item).grid.affine, expected, atol=2e-4)


@pytest.mark.parametrize("kind", ["COPY_LOCATION", "FOLLOW_PATH", "LIMIT_LOCATION"])
def test_constraints_are_part_of_the_place(scene, kind):
    item = volumes.add_volume(mph.Volume(np.ones((3, 4, 5), np.float32), mph.Grid.centered((3, 4, 5), 2.0)), "Box")
    local = volumes.volume_from_object(item).grid.affine
    constraint = item.constraints.new(kind)
    if kind != "LIMIT_LOCATION":
        constraint.target = curve(True)[0]
    else:
        constraint.use_min_x, constraint.min_x = True, 7.0
    select(item)
    bpy.context.view_layer.update()
    expected = np.array(item.matrix_world) @ local
    assert not np.allclose(expected, local)
    np.testing.assert_allclose(volumes.volume_from_object(item).grid.affine, expected, atol=2e-4)
