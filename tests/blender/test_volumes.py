"""Volumes in the scene: exact voxels, exact positions, files that stay with the .blend."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from mphdrr.addon.blender import compat, storage
from mphdrr.addon.volumes import looks, stored_volumes, vdb, volume_materials, volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.frames import euler_pose
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.volumes.volume import Volume

from .conftest import reopened, volume_picture

SHEAR = np.array([[1.0, 0.3, 0.0, 0.0], [0.0, 1.0, -0.2, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
AFFINES = {
    "isotropic": np.diag([2.0, 2.0, 2.0, 1.0]),
    "anisotropic": np.diag([0.703, 0.703, 2.5, 1.0]),
    "rotated": euler_pose(0.4, 0.7, -0.3, (30.0, -20.0, 10.0)) @ np.diag([1.0, 2.0, 3.0, 1.0]),
    "sheared": euler_pose(0.4, 0.7, -0.3, (5.0, 6.0, 7.0)) @ SHEAR @ np.diag([2.0, 1.5, 1.0, 1.0]),
    "mirrored": euler_pose(1.1, 0.2, 0.5, (4.0, -1.0, 2.0)) @ SHEAR @ np.diag([1.5, -2.0, 1.0, 1.0]),
}


@pytest.fixture
def sparse_volume() -> Volume:
    """Return voxels with zeros, negative, tiny and huge values, in a rotated anisotropic grid."""
    rng = np.random.default_rng(0)
    array = rng.normal(size=(21, 14, 9)).astype(np.float32)
    array[3:9] = 0.0
    array[0, 0, 0] = 1e-30
    array[-1, -1, -1] = 3e30
    return Volume(array, Grid(array.shape, AFFINES["rotated"]), "mu")


@pytest.mark.parametrize("name", AFFINES)
def test_volume_comes_back_from_its_object_exactly(name, sparse_volume):
    volume = Volume(sparse_volume.array, Grid(sparse_volume.grid.shape, AFFINES[name]), "mu")
    item = volumes.add_volume(volume, "Sample")
    back = volumes.volume_from_object(item)
    assert np.array_equal(back.array, volume.array) and back.quantity == "mu"
    np.testing.assert_allclose(back.grid.affine, volume.grid.affine, rtol=0, atol=1e-12)


def test_volume_comes_back_after_save_and_reopen(tmp_path, sparse_volume):
    unsaved = Path(volumes.add_volume(sparse_volume, "Sample").data.filepath)
    assert unsaved.is_absolute() and unsaved.is_file()
    reopened(tmp_path / "study.blend")
    item = bpy.data.objects["Sample"]
    back = volumes.volume_from_object(item)
    assert np.array_equal(back.array, sparse_volume.array)
    np.testing.assert_allclose(back.grid.affine, sparse_volume.grid.affine, rtol=0, atol=1e-12)
    assert item.data.filepath.startswith("//study_mphdrr/") and item.data.grids.load()


def test_moving_the_object_moves_the_volume(sparse_volume):
    item = volumes.add_volume(sparse_volume, "Sample")
    move = euler_pose(0.5, 0.2, 0.1, (11.0, -7.0, 3.0))
    item.matrix_world = Matrix(move) @ item.matrix_world
    back = volumes.volume_from_object(item)
    np.testing.assert_allclose(back.grid.affine, move @ sparse_volume.grid.affine, rtol=0, atol=1e-4)


def test_saving_a_copy_leaves_the_session_usable(tmp_path, sparse_volume):
    item = volumes.add_volume(sparse_volume, "Sample")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "copy.blend"), copy=True)
    assert np.array_equal(volumes.volume_from_object(item).array, sparse_volume.array)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "copy.blend"))
    item = bpy.data.objects["Sample"]
    assert item.data.filepath.startswith("//copy_mphdrr/")
    assert np.array_equal(volumes.volume_from_object(item).array, sparse_volume.array)


def test_large_volume_is_shown_coarser_but_kept_whole(monkeypatch):
    monkeypatch.setattr(stored_volumes, "MAX_SHOWN_VOXELS", 20**3)
    array = np.random.default_rng(1).random((31, 32, 33), dtype=np.float32)
    volume = Volume(array, Grid.centered(array.shape, 1.5, (1.0, 2.0, 3.0)), "activity")
    item = volumes.add_volume(volume, "Large")
    assert item.data.filepath.endswith(".preview.vdb")
    assert np.array_equal(volumes.volume_from_object(item).array, array)
    shown = vdb.read_vdb(Path(item.data.filepath))
    assert shown.grid.shape == (16, 16, 17)
    np.testing.assert_allclose(shown.array.sum() * 8, array.sum(), rtol=1e-5)
    # The first block's centre is the corner between its eight voxels.
    own = volumes.pose_of_object(item) @ shown.grid.affine
    np.testing.assert_allclose(own[:3, 3], (volume.grid.affine @ [0.5, 0.5, 0.5, 1.0])[:3])


def test_missing_voxels_are_a_clear_error(sparse_volume):
    item = volumes.add_volume(sparse_volume, "Sample")
    Path(item.data.filepath).unlink()
    with pytest.raises(InputError, match=r"Sample.*gone"):
        volumes.volume_from_object(item)
    with pytest.raises(InputError, match=r"Cube.*no mphDRR volume"):
        volumes.volume_from_object(bpy.data.objects["Cube"])


def test_replacing_a_volume_leaves_no_orphans(sparse_volume):
    item = volumes.add_volume(sparse_volume, "Sample")
    before = len(bpy.data.volumes), len(bpy.data.materials)
    other = Volume(sparse_volume.array[:5].copy(), Grid((5, 14, 9), np.eye(4)), "mu")
    volumes.replace_stored(item, stored_volumes.store_volume(other, storage.folder()))
    assert (len(bpy.data.volumes), len(bpy.data.materials)) == before
    assert volumes.volume_from_object(item).grid.shape == (5, 14, 9)


@pytest.mark.long
@pytest.mark.parametrize("name", ["sheared", "mirrored"])
def test_blender_draws_a_voxel_where_its_index_says(name, scene):
    """Cycles' picture of one bright voxel has its centroid at the voxel's centre, to a hundredth of a voxel."""
    affine = AFFINES[name]
    array = np.zeros((9, 7, 6), np.float32)
    array[5, 2, 3] = 1.0
    item = volumes.add_volume(Volume(array, Grid(array.shape, affine), "activity"), "Voxel")
    _only_emission(item)
    middle = (affine @ [5, 2, 3, 1])[:3]
    reach = float(np.abs(affine[:3, :3]).sum(axis=1).max())
    found = np.empty(3)
    for axes in ((0, 1), (2, 1)):
        found[list(axes)] = _centroid(scene, axes, middle + 0.137, 4 * reach)
    error = np.linalg.inv(affine[:3, :3]) @ (found - middle)
    assert np.abs(error).max() < 0.01, f"off by {error} voxels"


def _only_emission(item):
    tree = item.data.materials[0].node_tree
    tree.nodes.clear()
    attribute = tree.nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = "activity"
    emission = tree.nodes.new("ShaderNodeEmission")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(attribute.outputs["Fac"], emission.inputs["Strength"])
    tree.links.new(emission.outputs[0], output.inputs["Volume"])


def _centroid(scene, axes, aim, width, side=64):
    """Return the centroid along two world axes (picture right, picture up) of Cycles' orthographic picture, mm."""
    scene.cycles.pixel_filter_type, scene.cycles.volume_step_rate = "BOX", 0.25
    # 5.2 samples volumes randomly: the noise alone is about 0.004 voxel
    picture = volume_picture(scene, axes, aim, width, side, samples=128)[:, :, 0]
    assert picture.sum() > 0
    place = ((np.arange(side) + 0.5) / side - 0.5) * width
    return [aim[axis] + picture.sum(axis=k) @ place / picture.sum() for k, axis in enumerate(axes)]


def test_material_scale_follows_the_data(sparse_volume):
    item = volumes.add_volume(sparse_volume, "Sample")
    node = item.data.materials[0].node_tree.nodes["Look"]
    assert (node.inputs["Low"].default_value, node.inputs["High"].default_value) == (0, pytest.approx(3e30))
    item.mphdrr_volume.display_low, item.mphdrr_volume.display_high = 0.5, 2.0
    assert (node.inputs["Low"].default_value, node.inputs["High"].default_value) == (0.5, 2.0)
    assert item.data.render.clipping == 0.0


def test_volumes_are_within_eevees_reach(scene):
    volume_materials.show_in_eevee(scene)
    assert not scene.eevee.use_volume_custom_range or scene.eevee.volumetric_end > 1000
    scene.eevee.use_volume_custom_range = True
    scene.eevee.volumetric_end = 321.0
    volume_materials.show_in_eevee(scene)
    assert scene.eevee.use_volume_custom_range and scene.eevee.volumetric_end == 321.0


def test_volume_drawn_for_another_blender_is_rewritten_on_load(tmp_path, sparse_volume, monkeypatch):
    monkeypatch.setattr(compat, "VDB_CENTER_SHIFT", -0.5 - compat.VDB_CENTER_SHIFT)
    item = volumes.add_volume(sparse_volume, "Sample")
    item.mphdrr_volume.look = "SHELL"
    elsewhere = looks.surfaces_of(item)[0].location.copy()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    monkeypatch.undo()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    item = bpy.data.objects["Sample"]
    assert item.mphdrr_volume.center_shift == compat.VDB_CENTER_SHIFT
    assert np.array_equal(volumes.volume_from_object(item).array, sparse_volume.array)
    assert looks.surfaces_of(item)[0].location != elsewhere, "the surface goes along"
    assert len({p.name for p in (tmp_path / "a_mphdrr").iterdir()}) == 2
