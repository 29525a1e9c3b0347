"""A file that comes back after a crash, without the temporary folder: what has a recipe is made again."""

from __future__ import annotations

import shutil

import bpy
import numpy as np
import pytest

from mphdrr.addon import recovery
from mphdrr.addon.blender import jobs, storage
from mphdrr.addon.phantoms import phantom_properties, phantoms
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.volumes.volume import Volume

TANK = {"rod_diameters": (0,) * 6, "sphere_diameters": (30, 0, 0, 0, 0, 0)}  # little to paint


@pytest.fixture
def crashed(scene, small_workbook, tmp_path, capsys):
    """A scene with volumes of every origin, opened again after their files have gone; returns their voxels by name."""
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    job = phantoms.add_phantom_job(phantom_properties.plain_settings("jaszczak", voxels=24, **TANK), "Tank", None, True)
    jobs.run(job)
    bpy.data.objects["Tank"].location = (3.0, 4.0, 5.0)
    bpy.ops.mphdrr.add_map(quantity="modules", voxels=6, side=90, within_roi=False)
    bpy.context.view_layer.update()
    made = {item.name: volumes.volume_from_object(item) for item in volumes.volume_objects(scene)}
    volumes.add_volume(Volume(np.ones((4, 4, 4)), Grid.centered(4, 1.0), "hu"), "CT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "study.blend"))
    shutil.rmtree(tmp_path / "study_mphdrr")
    storage._cached_size.cache_clear()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "study.blend"))
    said = capsys.readouterr().out
    assert "Modules map, Tank are missing: press Make Again" in said
    assert "CT are missing: Find Missing Volume Files, or import again" in said
    return made


def test_one_update_gives_one_grid(crashed):
    item = bpy.data.objects["Tank"]
    bpy.context.view_layer.objects.active = item
    assert not item.data.grids.load()
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert item.data.grids.load() and [grid.name for grid in item.data.grids] == ["activity"]
    assert np.array_equal(volumes.volume_from_object(item).array, crashed["Tank"].array)


def test_all_with_a_recipe_are_made_again_where_they_were(crashed, capsys):
    storage._cached_size.cache_clear()
    assert bpy.ops.mphdrr.remake_volumes() == {"FINISHED"}
    assert "CT: find the voxel files" in capsys.readouterr().out
    storage._cached_size.cache_clear()
    again, others = recovery.missing_volumes(bpy.context.scene)
    assert again == [] and [item.name for item in others] == ["CT"]
    assert set(crashed) == {"Tank", "Tank mu", "Modules map"}
    for name, volume in crashed.items():
        back = volumes.volume_from_object(bpy.data.objects[name])
        assert np.array_equal(back.array, volume.array)
        np.testing.assert_allclose(back.grid.affine, volume.grid.affine, atol=1e-6)
    with pytest.raises(RuntimeError, match="No phantom or map misses its file"):
        bpy.ops.mphdrr.remake_volumes()
