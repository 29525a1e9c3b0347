"""Maps of the scanner as volumes in the scene."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import jobs
from mphdrr.addon.scanner import maps, scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.physics.maps import sensitivity_map
from mphdrr.core.physics.performance import sensitivity
from mphdrr.core.volumes.volume import Volume


@pytest.fixture
def collection(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    return scanner.active_scanner(scene)


def the_map(quantity="sensitivity"):
    (item,) = [o for o in volumes.volume_objects(bpy.context.scene) if o.mphdrr_volume.quantity == quantity]
    return item


def test_map_is_the_cores_within_the_roi(collection):
    assert bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=12) == {"FINISHED"}
    volume = volumes.volume_from_object(the_map())
    system = scanner.read_scanner(collection)
    expected = sensitivity_map(system, volume.grid).array
    corners = np.stack(np.meshgrid(*map(np.arange, volume.grid.shape), indexing="ij"), axis=-1)
    places = corners @ volume.grid.affine[:3, :3].T + volume.grid.affine[:3, 3]
    inside = np.linalg.norm(places, axis=-1) <= system.roi_radius.max()
    assert np.array_equal(volume.array, np.where(inside, expected, 0))
    assert the_map().mphdrr_volume.unit == "cps/MBq"


def test_map_follows_the_scanner_and_is_replaced(collection):
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=5, within_roi=False)
    before = volumes.volume_from_object(the_map())
    module = scanner.module(collection, 1).mphdrr_module
    module.pinhole_diameter = 4.0
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=5, within_roi=False)
    after = volumes.volume_from_object(the_map())
    middle = np.zeros((1, 3))
    gained = sensitivity(scanner.read_scanner(collection), middle)[0, 0] * (1 - (2.3 / 4.0) ** 2)
    assert after.array[2, 2, 2] - before.array[2, 2, 2] == pytest.approx(gained, rel=1e-4)


def test_each_scanner_has_its_own_map_and_no_other_volume_is_replaced(collection, scene, small_workbook):
    volumes.add_volume(Volume(np.ones((3, 3, 3)), Grid.centered(3, 1.0), "sensitivity"), "Measured")
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=3, within_roi=False)
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="Other")
    other = scanner.active_scanner(scene)
    scanner.module(other, 1).mphdrr_module.pinhole_diameter = 4.6
    for _ in range(2):
        bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=3, within_roi=False)
    of_other, of_first = (bpy.data.objects[name] for name in ("Sensitivity map.001", "Sensitivity map"))
    assert len(volumes.volume_objects(scene)) == 3 and np.all(volumes.volume_from_object(of_first).array)
    ratio = volumes.volume_from_object(of_other).array / volumes.volume_from_object(of_first).array
    of_modules = sensitivity(scanner.read_scanner(other), np.zeros((1, 3)))[0]
    assert ratio[1, 1, 1] == pytest.approx(of_modules.sum() / (of_modules.sum() - 0.75 * of_modules[0]), rel=1e-5)
    before = volumes.volume_from_object(of_first).array
    jobs.run(maps.remake_map_job(scene, of_first))  # while the other scanner is active
    assert np.array_equal(volumes.volume_from_object(of_first).array, before)


def test_maps_are_not_projected(collection):
    bpy.ops.mphdrr.add_map(quantity="modules", voxels=4)
    with pytest.raises(RuntimeError, match="no volume of activity or mu in the scene"):
        bpy.ops.mphdrr.render_projections(width=4, height=4)
    bpy.ops.mphdrr.add_derenzo(voxels=16, rod_diameters=(10, 8, 0, 0, 0, 0))
    assert bpy.ops.mphdrr.render_projections(width=4, height=4) == {"FINISHED"}


def test_a_maps_surface_is_at_a_value_of_the_windows_unit(collection):
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=12, within_roi=False)
    item = the_map()
    bpy.context.view_layer.objects.active = item
    settings = item.mphdrr_volume
    level = 0.7 * settings.maximum
    assert level > 100, "cps/MBq"
    assert bpy.ops.mphdrr.mesh_from_volume(level=level) == {"FINISHED"}
    mesh = bpy.data.meshes[f"{item.name} surface"]
    system = scanner.read_scanner(collection)
    places = np.array([vertex.co for vertex in mesh.vertices])
    values = 1e6 * sensitivity(system, places).sum(axis=1)
    assert np.median(values) == pytest.approx(level, rel=0.1)


@pytest.mark.parametrize("quantity", ["modules", "resolution", "completeness"])
def test_other_maps(collection, quantity):
    assert bpy.ops.mphdrr.add_map(quantity=quantity, voxels=4, side=20) == {"FINISHED"}
    low, high = {"modules": (16, 16), "resolution": (5, 20), "completeness": (0.8, 1.0)}[quantity]
    values = volumes.volume_from_object(the_map(quantity)).array
    assert values.min() >= low and values.max() <= high
