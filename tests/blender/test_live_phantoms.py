"""Phantoms follow their settings: at once, when the settings rest (the timer is called by hand), or on Update."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import storage, windows
from mphdrr.addon.phantoms import live_phantoms, phantoms
from mphdrr.addon.volumes import slices, volumes
from mphdrr.core.errors import InputError


@pytest.fixture
def item():
    """A phantom of two quantities, 12^3 voxels."""
    bpy.ops.mphdrr.add_shepp_logan(voxels=12, half_size=40, attenuation=True, location=(3, 4, 5))
    return bpy.context.object


@pytest.fixture
def window(monkeypatch):
    """A window in which every phantom is too large to be made at every edit."""
    monkeypatch.setattr(windows, "has_window", lambda: True)
    monkeypatch.setattr(live_phantoms, "QUICK_VOXELS", 0)


def is_waiting() -> bool:
    return bpy.app.timers.is_registered(live_phantoms._update_edited)


def assert_made(item) -> None:
    """The voxels of every quantity follow from the settings and the object's pose."""
    recipe = phantoms.copy_settings(phantoms.settings_of(item))
    for one in phantoms.with_children(item):
        volume = volumes.volume_from_object(one)
        assert np.array_equal(volume.array, recipe.phantom.voxelize(recipe.grid, quantity=volume.quantity).array)
        np.testing.assert_allclose(volume.grid.affine, volumes.pose_of_object(one) @ recipe.grid.affine, atol=1e-5)
    assert not item.mphdrr_volume.outdated and not item.mphdrr_volume.message


def test_a_small_phantom_follows_every_edit(item):
    data, settings = item.data, item.mphdrr_volume.shepp_logan
    look = data.materials[0].node_tree.nodes["Look"].inputs
    look["Density"].default_value *= 3
    density, planes = look["Density"].default_value, slices.add_slices(item)
    settings.half_size = 44
    assert_made(item)
    assert item.data == data, "in place: what was set on it stays"
    assert look["Density"].default_value == density, "as opaque as before: the opacity per mm follows the size"
    assert look["Size"].default_value == pytest.approx(item.mphdrr_volume.extent)
    assert slices.planes_of(item) and slices.planes_of(item) != planes
    assert not is_waiting()


def test_a_larger_one_is_made_when_its_settings_rest(item, window):
    settings, before = item.mphdrr_volume.shepp_logan, volumes.volume_from_object(item)
    for half_size in (44, 48):
        settings.half_size = half_size
        assert item.mphdrr_volume.outdated and is_waiting()
        assert np.array_equal(volumes.volume_from_object(item).array, before.array)
    assert live_phantoms._update_edited() is None
    assert_made(item)


def test_the_largest_wait_for_update_and_nobody_takes_old_voxels_for_new(item, window, monkeypatch, tmp_path):
    monkeypatch.setattr(live_phantoms, "RESTED_VOXELS", 1000)
    item.mphdrr_volume.shepp_logan.activity = 11
    assert not is_waiting()
    for one in phantoms.with_children(item):
        with pytest.raises(InputError, match="press Update Phantom first"):
            phantoms.require_current(one)
    with pytest.raises(RuntimeError, match="press Update Phantom first"):
        bpy.ops.mphdrr.export_volume(filepath=str(tmp_path / "a.vdb"))
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert_made(item)


def test_what_cannot_be_made_is_said_and_not_tried_again(item, window, monkeypatch):
    settings = item.mphdrr_volume.shepp_logan
    item.scale.x = 0
    settings.half_size = 35
    assert "cannot be inverted" in item.mphdrr_volume.message and item.mphdrr_volume.outdated and not is_waiting()
    item.scale.x = 1
    settings.half_size = 32
    assert not item.mphdrr_volume.message and is_waiting()
    bpy.data.objects.remove(item)
    assert live_phantoms._update_edited() is None


def test_an_undo_takes_back_voxels_and_settings_together(item):
    name = item.name
    bpy.ops.ed.undo_push(message="added")
    item.mphdrr_volume.shepp_logan.half_size = 30
    bpy.ops.ed.undo_push(message="changed")
    for step, half_size in ((bpy.ops.ed.undo, 40), (bpy.ops.ed.redo, 30)):
        assert step() == {"FINISHED"}
        item = bpy.data.objects[name]
        assert item.mphdrr_volume.shepp_logan.half_size == half_size
        assert_made(item)


def test_a_volume_that_goes_while_voxels_are_made(item):
    stored = phantoms.make_voxelizer(item)(None)
    bpy.data.objects.remove(item.children[0])
    with pytest.raises(InputError, match="try again"):
        phantoms.replace_voxels(item, stored)


def test_a_setting_that_changes_while_an_update_is_made(item, window, monkeypatch):
    remaking, settings = phantoms.make_voxelizer, item.mphdrr_volume.shepp_logan

    def edited_meanwhile(*arguments):
        work = remaking(*arguments)

        def working(progress):
            made = work(progress)
            settings.half_size = 55
            return made

        return working

    monkeypatch.setattr(phantoms, "make_voxelizer", edited_meanwhile)
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert item.mphdrr_volume.outdated and is_waiting()
    monkeypatch.undo()
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert_made(item)


def test_panels_look_at_the_disk_now_and_then(item, monkeypatch):
    monkeypatch.setattr(storage, "_SIZE_LIFETIME", 1e9)
    path = volumes.file_of(item)
    assert "KiB" in volumes.file_note(item) and storage.missing_volumes() == []
    content = path.read_bytes()
    path.unlink()
    assert "KiB" in volumes.file_note(item) and storage.missing_volumes() == []
    storage._cached_size.cache_clear()
    assert volumes.file_note(item) == "missing" and storage.missing_volumes() == [item.data]
    path.write_bytes(content)
    storage._cached_size.cache_clear()
    assert "KiB" in volumes.file_note(item)
