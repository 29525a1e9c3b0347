"""Phantoms while their settings are dragged: sketches at once, voxels when it rests. The timer is called by hand."""

from __future__ import annotations

import time
import warnings

import bpy
import numpy as np
import pytest

from mphdrr.addon import live_phantoms, phantoms, scanner, slices, storage, volumes
from mphdrr.core.errors import InputError


@pytest.fixture(autouse=True)
def window(monkeypatch):
    monkeypatch.setattr(live_phantoms, "_has_window", lambda: True)
    monkeypatch.setattr(live_phantoms, "_REST", 0.0)


@pytest.fixture
def item():
    """A phantom of two quantities, 36^3 voxels, that has been made."""
    bpy.ops.mphdrr.add_shepp_logan(voxels=36, half_size=40, attenuation=True, location=(3, 4, 5))
    return bpy.context.object


def rest() -> None:
    """What the window's timer does until nothing is left to do."""
    until = time.monotonic() + 60
    while live_phantoms._look() is not None:
        assert time.monotonic() < until
        time.sleep(0.01)


def assert_made(item) -> None:
    """The voxels are those of the settings, of every quantity, at the object."""
    recipe = phantoms.recipe_of(phantoms.settings_of(item))
    for one in phantoms.with_children(item):
        properties = one.mphdrr_volume
        volume = volumes.volume_from_object(one)
        expected = recipe.phantom.voxelize(recipe.grid, quantity=properties.quantity)
        assert np.array_equal(volume.array, expected.array)
        np.testing.assert_allclose(volume.grid.affine, volumes.pose_of_object(one) @ recipe.grid.affine, atol=1e-5)
        assert not properties.sketched and not item.mphdrr_volume.outdated


def test_a_sketch_comes_at_once_and_the_voxels_when_it_rests(item):
    data, settings = item.data, item.mphdrr_volume.shepp_logan
    data.materials[0].node_tree.nodes["Opacity"].outputs[0].default_value *= 3
    opaque = data.materials[0].node_tree.nodes["Opacity"].outputs[0].default_value * item.mphdrr_volume.extent
    planes = slices.add_slices(item)
    for half_size in (44, 48, 52):
        settings.half_size = half_size
        for one in phantoms.with_children(item):
            assert one.mphdrr_volume.sketched and tuple(one.mphdrr_volume.shape) == (32, 32, 32)
        shown = volumes.read_vdb(volumes.file_of(item))
        grid = phantoms.recipe_of(settings).grid
        np.testing.assert_allclose(np.multiply(shown.grid.shape, shown.grid.spacing), 36 * np.array(grid.spacing))
        exact = settings.phantom().values((shown.grid.affine @ [16, 9, 15, 1])[:3][None])
        assert shown.array[16, 9, 15] == pytest.approx(exact[0])
        assert slices.planes_of(item) == planes, "slices wait for the voxels"
    assert live_phantoms.is_coming(item)
    rest()
    assert_made(item)
    assert item.data == data, "in place: what was set on it stays"
    now = data.materials[0].node_tree.nodes["Opacity"].outputs[0].default_value * item.mphdrr_volume.extent
    assert now == pytest.approx(opaque, rel=1e-5)
    assert slices.planes_of(item) and slices.planes_of(item) != planes


def test_an_edit_stops_what_is_being_made(item, monkeypatch):
    settings = item.mphdrr_volume.shepp_logan
    settings.half_size = 50
    assert live_phantoms._look() is not None
    _, first = live_phantoms._refinement
    settings.half_size = 30
    assert first.cancel.is_set() and live_phantoms._refinement is None
    rest()
    assert_made(item)
    item.scale.x = 0
    settings.half_size = 35
    assert (
        "cannot be inverted" in item.mphdrr_volume.message
        and item.mphdrr_volume.outdated
        and not item.mphdrr_volume.sketched
    )
    item.scale.x = 1
    settings.half_size = 32

    def failing(*_):
        raise InputError("no room")

    monkeypatch.setattr(phantoms.Recipe, "voxelize", failing)
    rest()
    assert item.mphdrr_volume.message == "no room" and not live_phantoms.is_coming(item), "once, not over and over"
    monkeypatch.undo()
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert_made(item)


def test_nobody_takes_a_sketch_for_voxels(item, scene, ring_system, monkeypatch):
    scanner.build_scanner(scene, ring_system)
    settings = item.mphdrr_volume.shepp_logan
    settings.activity = 7
    assert volumes.volume_from_object(item.children[0]).array.shape == (36,) * 3
    assert_made(item)
    settings.activity = 9
    bpy.ops.mphdrr.render_projections(width=8, height=8, volume=item.name)
    assert_made(item)
    # More voxels than are made by themselves wait for the user.
    monkeypatch.setattr(live_phantoms, "REFINED_VOXELS", 1000)
    settings.activity = 11
    assert not live_phantoms.is_coming(item)
    for call in (lambda: volumes.volume_from_object(item), lambda: bpy.ops.mphdrr.render_projections(volume=item.name)):
        with pytest.raises((InputError, RuntimeError), match="press Update Phantom first"):
            call()
    bpy.context.view_layer.objects.active = item
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert_made(item)


def test_python_warns_as_before_whenever_a_thread_ends(item, monkeypatch):
    filters, settings, sketch = warnings.filters, item.mphdrr_volume.shepp_logan, phantoms.sketch
    settings.half_size = 50
    assert live_phantoms._look() is not None
    _, first = live_phantoms._refinement

    def sketch_later(one):
        first.thread.join()
        sketch(one)

    monkeypatch.setattr(phantoms, "sketch", sketch_later)
    settings.half_size = 30
    assert warnings.filters is filters
    rest()
    assert_made(item)
    assert warnings.filters is filters


def test_a_volume_that_goes_while_it_is_being_made(item):
    item.mphdrr_volume.shepp_logan.half_size = 50
    assert live_phantoms._look() is not None
    bpy.data.objects.remove(item.children[0])
    rest()
    assert_made(item)


def test_a_setting_that_changes_while_an_update_is_made(item, monkeypatch):
    remaking, settings = phantoms.remaking, item.mphdrr_volume.shepp_logan

    def edited_meanwhile(*arguments):
        work = remaking(*arguments)

        def working(progress):
            made = work(progress)
            settings.half_size = 55
            return made

        return working

    monkeypatch.setattr(phantoms, "remaking", edited_meanwhile)
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert item.mphdrr_volume.outdated
    monkeypatch.undo()
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert_made(item)


def test_undo_redo_and_files_bring_sketches_that_become_voxels(item, tmp_path):
    name = item.name
    bpy.ops.ed.undo_push(message="added")
    item.mphdrr_volume.shepp_logan.half_size = 30
    bpy.ops.ed.undo_push(message="changed")
    rest()  # after the undo step
    assert bpy.ops.ed.undo() == {"FINISHED"}
    item = bpy.data.objects[name]
    assert item.mphdrr_volume.shepp_logan.half_size == 40
    assert_made(item)
    assert bpy.ops.ed.redo() == {"FINISHED"}
    item = bpy.data.objects[name]
    assert item.mphdrr_volume.shepp_logan.half_size == 30 and item.mphdrr_volume.sketched
    rest()
    assert_made(item)
    item.mphdrr_volume.shepp_logan.half_size = 35
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    item = bpy.data.objects[name]
    assert item.mphdrr_volume.sketched
    rest()
    assert_made(item)
    assert storage.absolute(item.data.filepath).parent == tmp_path / "a_mphdrr"


def test_a_phantom_begins_to_beat_and_stands_still_again():
    bpy.ops.mphdrr.add_torso(voxels=8, phase=0.35)
    item = bpy.context.object
    still, settings = volumes.file_of(item), item.mphdrr_volume.torso
    settings.frames = 2
    assert not item.data.is_sequence
    rest()
    assert item.data.is_sequence and item.data.frame_duration == 2 and not item.mphdrr_volume.sketched
    settings.frames = 1
    rest()
    assert not item.data.is_sequence and volumes.file_of(item) == still, "files are named by content"


def test_panels_look_at_the_disk_now_and_then(item, monkeypatch):
    path = volumes.file_of(item)
    assert "KiB" in volumes.file_state(item) and storage.missing_volumes(storage.seems_there) == []
    content = path.read_bytes()
    path.unlink()
    assert "KiB" in volumes.file_state(item) and storage.missing_volumes() == [item.data]
    monkeypatch.setattr(storage, "_LOOK", -1.0)
    assert volumes.file_state(item) == "missing" and storage.missing_volumes(storage.seems_there) == [item.data]
    path.write_bytes(content)
    assert "KiB" in volumes.file_state(item)
