"""Mesh objects become volumes, and volumes meshes."""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest

from mphdrr.addon.volumes import volumes

from .conftest import centroid, refused, select


def added():
    (item,) = volumes.volume_objects(bpy.context.scene)
    return volumes.volume_from_object(item)


def content(volume):
    """Return the sum of value times mm^3."""
    return float(volume.array.sum(dtype=np.float64)) * volume.grid.voxel_volume


@pytest.fixture(autouse=True)
def nothing_else(scene):
    bpy.data.batch_remove(list(bpy.data.objects))


def new_sphere(radius=20.0, location=(3.0, -4.0, 5.0)):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=128, ring_count=64, radius=radius, location=location)
    return bpy.context.object


def test_sphere_holds_its_activity():
    select(new_sphere())
    assert bpy.ops.mphdrr.voxelize_objects(value=7.0, voxels=24) == {"FINISHED"}
    volume = added()
    assert volume.quantity == "activity"
    assert content(volume) == pytest.approx(7.0 * 4 / 3 * math.pi * 20**3, rel=5e-3)
    assert centroid(volume) == pytest.approx([3.0, -4.0, 5.0], abs=1e-3)


def test_modifier_and_turned_scaled_mirrored_parent():
    bpy.ops.object.empty_add(location=(10, 20, 30), rotation=(0.3, 0.5, 0.7))
    parent = bpy.context.object
    parent.scale = (2.0, -1.5, 0.5)
    bpy.ops.mesh.primitive_cube_add(size=10.0, location=(1, 2, 3), rotation=(0.2, 0.1, 0.4))
    cube = bpy.context.object
    cube.parent = parent
    array = cube.modifiers.new("Array", "ARRAY")
    array.count, array.use_relative_offset, array.use_constant_offset = 3, False, True
    array.constant_offset_displace = (15.0, 0.0, 0.0)
    select(cube)
    bpy.ops.mphdrr.voxelize_objects(quantity="mu", value=0.02, voxels=40)
    assert content(added()) == pytest.approx(0.02 * 3 * 10**3 * 1.5, rel=5e-3)


def test_objects_have_values_of_their_own_and_cover_earlier_names():
    outer, inner = new_sphere(20.0, (0, 0, 0)), new_sphere(8.0, (0, 0, 0))
    outer.name, inner.name = "1 body", "2 lesion"
    inner["activity"] = 50.0
    select(outer, inner)
    bpy.ops.mphdrr.voxelize_objects(value=10.0, voxels=40, name="patient")
    volume = added()
    expected = 4 / 3 * math.pi * (10 * (20**3 - 8**3) + 50 * 8**3)
    assert content(volume) == pytest.approx(expected, rel=5e-3)
    assert volumes.volume_objects(bpy.context.scene)[0].name == "patient"


def test_open_mesh_is_named_with_the_place():
    bpy.ops.mesh.primitive_plane_add(size=10.0, location=(0, 0, 5))
    bpy.context.object.name = "lid"
    select(bpy.context.object)
    refused(bpy.ops.mphdrr.voxelize_objects, r"'lid': .*not closed at 4 edges")
    assert not volumes.volume_objects(bpy.context.scene)


def test_scanner_parts_are_not_voxelized(workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    select(*[o for o in bpy.context.scene.objects if o.type == "MESH"])
    refused(bpy.ops.mphdrr.voxelize_objects, "Select closed mesh")


@pytest.mark.long
def test_volume_to_mesh_and_back():
    select(new_sphere())
    bpy.ops.mphdrr.voxelize_objects(value=1.0, voxels=60)
    (volume,) = volumes.volume_objects(bpy.context.scene)
    volume.location.x += 12.0
    select(volume)
    bpy.ops.mphdrr.mesh_from_volume()
    surface = bpy.data.objects[f"{volume.name} surface"]
    bpy.data.objects.remove(volume)
    select(surface)
    bpy.ops.mphdrr.voxelize_objects(value=1.0, voxels=60)
    again = added()
    assert content(again) == pytest.approx(4 / 3 * math.pi * 20**3, rel=2e-2)
    assert again.grid.center[0] == pytest.approx(15.0, abs=0.1)
    assert volumes.volume_objects(bpy.context.scene)[0].mphdrr_volume.quantity == "activity"
