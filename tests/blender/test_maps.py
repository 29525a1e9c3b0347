"""Maps of the scanner as volumes in the scene."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.addon import scanner, volumes
from mphdrr.core.physics.maps import sensitivity_map
from mphdrr.core.physics.performance import sensitivity


@pytest.fixture
def collection(scene, workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
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


def test_maps_are_not_projected(collection):
    bpy.ops.mphdrr.add_map(quantity="modules", voxels=4)
    with pytest.raises(RuntimeError, match="no volume of activity or mu in the scene"):
        bpy.ops.mphdrr.render_projections(width=4, height=4)
    bpy.ops.mphdrr.add_derenzo(voxels=16)
    assert bpy.ops.mphdrr.render_projections(width=4, height=4) == {"FINISHED"}


@pytest.mark.parametrize("quantity", ["modules", "resolution", "completeness"])
def test_other_maps(collection, quantity):
    assert bpy.ops.mphdrr.add_map(quantity=quantity, voxels=4, side=20) == {"FINISHED"}
    low, high = {"modules": (80, 80), "resolution": (5, 20), "completeness": (0.8, 1.0)}[quantity]
    values = volumes.volume_from_object(the_map(quantity)).array
    assert values.min() >= low and values.max() <= high
