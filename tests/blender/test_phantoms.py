"""Phantoms in the scene: every kind equals core's and follows its settings, at once, at rest or on Update."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from mphdrr.addon.blender import jobs, objects, storage, windows
from mphdrr.addon.phantoms import live_phantoms, phantom_properties, phantoms
from mphdrr.addon.volumes import slices, volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.frames import euler_pose
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.phantoms.kinds import KINDS
from mphdrr.core.phantoms.language import read_phantom
from mphdrr.core.phantoms.phantom import Phantom
from mphdrr.core.projector import Projector
from mphdrr.core.volumes.volume import Volume

from .conftest import datablocks, refused, reopened

THORAX = Path(__file__).parents[2] / "examples" / "phantoms" / "thorax.toml"
POSE = {"location": (4.0, -5.0, 6.0), "phi": 0.5, "theta": 0.25, "psi": -0.125}  # whole in float32


def pose() -> np.ndarray:
    return euler_pose(POSE["phi"], POSE["theta"], POSE["psi"], POSE["location"])


def add(name: str, **arguments):
    assert getattr(bpy.ops.mphdrr, f"add_{name.replace('-', '_')}")(**arguments) == {"FINISHED"}
    return bpy.context.object


def voxels_of(item) -> np.ndarray:
    return volumes.volume_from_object(item).array


def expected(phantom: Phantom, voxels: int, quantity: str = "activity") -> Volume:
    """Return the phantom on a cube that contains it, in its own frame."""
    low, high = phantom.box
    grid = Grid.centered((voxels,) * 3, (high - low).max() / (voxels - 2), (low + high) / 2)
    return phantom.voxelize(grid, quantity=quantity)


def total(volume: Volume) -> float:
    return float(volume.array.sum(dtype=np.float64)) * volume.grid.voxel_volume * 1e-3


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_kind_is_core_s_at_its_pose(kind):
    item = add(kind.name, voxels=20, **POSE)
    settings = phantoms.settings_of(item)
    assert settings == getattr(item.mphdrr_volume, phantom_properties.identifier(kind))
    phantom = kind.phantom(**kind.usual)
    assert dataclasses.asdict(settings.phantom()) == dataclasses.asdict(phantom)
    volume, own = volumes.volume_from_object(item), expected(phantom, 20)
    assert np.array_equal(volume.array, own.array)
    np.testing.assert_allclose(volume.grid.affine, pose() @ own.grid.affine, atol=1e-12)
    assert total(volume) == pytest.approx(phantom.total_activity, rel=1e-3)


def test_arguments_are_the_fields_of_the_class():
    item = add("points", voxels=16, counts=(1, 2, 3), spacing=(9, 8, 7), diameter=2, point_activity=3)
    assert phantoms.settings_of(item).phantom() == KINDS[5].phantom((1, 2, 3), (9, 8, 7), 2, 3)
    item = add("derenzo", voxels=32, voxel_size=3, radius=40, rod_diameters=(8, 6, 5, 4, 3, 2), height=30, activity=50)
    phantom = KINDS[0].phantom(40.0, (8.0, 6.0, 5.0, 4.0, 3.0, 2.0), 30.0, 50.0)
    assert np.array_equal(voxels_of(item), phantom.voxelize(Grid.centered(32, 3.0)).array)
    assert item.mphdrr_volume.kind == "DERENZO" and item.data.grids.load() and not item.data.grids.error_message
    item = add("shepp-logan", voxels=16, contrast="original", quantity="mu")
    assert item.mphdrr_volume.quantity == "mu"
    assert np.array_equal(voxels_of(item), expected(KINDS[4].phantom(contrast="original"), 16, "mu").array)


def test_a_phantom_follows_its_settings_where_it_stands():
    item = add("shepp-logan", voxels=12, attenuation=True, **POSE)
    (child,) = item.children
    assert child.mphdrr_volume.quantity == "mu" and item.name == "Shepp-Logan Head"
    item.matrix_world = Matrix.Translation((1, 2, 3)) @ item.matrix_world @ Matrix.Scale(2, 4)
    moved = np.array(item.matrix_basis)
    settings = item.mphdrr_volume.shepp_logan
    settings.half_size, settings.activity = 75, 40
    assert not item.mphdrr_volume.outdated and not item.mphdrr_volume.message
    phantom = KINDS[4].phantom(half_size=75, activity=40)
    for one, quantity in ((item, "activity"), (child, "mu")):
        volume, own = volumes.volume_from_object(one), expected(phantom, 12, quantity)
        assert np.array_equal(volume.array, own.array)
        np.testing.assert_allclose(volume.grid.affine, moved @ own.grid.affine, atol=1e-4)


def test_scripts_add_what_operators_add():
    arguments = {"half_size": 60.0, "voxels": 12, "contrast": "original"}
    added = add("shepp-logan", attenuation=True, **POSE, **arguments)
    settings = phantom_properties.plain_settings("shepp-logan", **arguments)
    assert "Head" in jobs.run(phantoms.add_phantom_job(settings, "Head", pose(), attenuation=True))
    item = bpy.context.object
    assert phantoms.settings_of(item).values() == phantoms.settings_of(added).values()
    for one, other in zip(phantoms.with_children(item), phantoms.with_children(added), strict=True):
        assert volumes.file_of(one) == volumes.file_of(other), "files are named by content"
    with pytest.raises(InputError, match="no setting 'size'"):
        phantom_properties.plain_settings("shepp-logan", size=3)
    with pytest.raises(InputError, match="expected one of derenzo"):
        phantom_properties.plain_settings("head")


@pytest.mark.long
def test_settings_that_cannot_be_leave_the_voxels_and_say_why():
    item = add("defrise", voxels=24)
    before, settings = voxels_of(item), item.mphdrr_volume.defrise
    settings.spacing = 1.0
    assert "disk thickness" in item.mphdrr_volume.message and item.mphdrr_volume.outdated
    assert np.array_equal(voxels_of(item), before)
    refused(bpy.ops.mphdrr.update_phantom, "disk thickness")
    assert np.array_equal(voxels_of(item), before)
    settings.spacing = 9.0
    assert not item.mphdrr_volume.message and not np.array_equal(voxels_of(item), before)
    item = add("points", voxels=12)
    item.mphdrr_volume.points.quantity = "mu"
    assert "has no mu" in item.mphdrr_volume.message and item.mphdrr_volume.quantity == "activity"


def test_phantoms_that_cannot_be_are_refused_and_add_nothing():
    before = datablocks("objects", "volumes")
    for operator, words, settings in (
        (bpy.ops.mphdrr.add_torso, "defect from", {"defect_from": 0.9}),
        (bpy.ops.mphdrr.add_points, "grid of points has no mu", {"voxels": 8, "attenuation": True}),
        (bpy.ops.mphdrr.add_derenzo, "rod", {"rod_diameters": (0.0,) * 6}),
        (bpy.ops.mphdrr.add_derenzo, "rod", {"radius": 1.0}),
        (bpy.ops.mphdrr.add_derenzo, "memory", {"voxels": 4096}),
    ):
        refused(operator, words, **settings)
    assert datablocks("objects", "volumes") == before


def test_settings_survive_saving_and_copies_follow_their_own(tmp_path):
    add("shepp-logan", voxels=8, activity=3, **POSE)
    reopened(tmp_path / "a.blend")
    item = bpy.data.objects["Shepp-Logan Head"]
    copy = item.copy()
    bpy.context.collection.objects.link(copy)
    copy.mphdrr_volume.shepp_logan.activity = 5
    for one, activity in ((item, 3), (copy, 5)):
        assert np.array_equal(voxels_of(one), expected(KINDS[4].phantom(activity=activity), 8).array)


def test_toml_becomes_a_text_that_the_phantom_follows(tmp_path):
    file = tmp_path / "thorax.toml"
    file.write_text(THORAX.read_text())
    assert bpy.ops.mphdrr.import_phantom(filepath=str(file), voxels=20, attenuation=True, **POSE) == {"FINISHED"}
    item, phantom = bpy.context.object, read_phantom(file)
    file.unlink()
    assert item.name == phantom.name
    for one, quantity in ((item, "activity"), (item.children[0], "mu")):
        assert np.array_equal(voxels_of(one), expected(phantom, 20, quantity).array)
    text = item.mphdrr_volume.file.text
    text.from_string('[[shape]]\nkind = "sphere"\nradius = 10\nactivity = 4\nmu = 0.01\n')
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert total(volumes.volume_from_object(item)) == pytest.approx(16 / 3 * np.pi, rel=1e-3)
    text.from_string('[[shape]]\nkind = "sphere"\n')
    refused(bpy.ops.mphdrr.update_phantom, r"thorax.toml: shape 1: radius: missing")
    item.mphdrr_volume.file.text = None
    assert "no text is chosen" in item.mphdrr_volume.message


@pytest.mark.parametrize(
    ("text", "message"),
    [("[[shape]", "not TOML"), ("name = 3", r"\[\[shape\]\]"), ('[[shape]]\nkind = "cube"', "kind"), (None, "no such")],
)
def test_toml_that_is_no_phantom_adds_nothing(text, message, tmp_path):
    file = tmp_path / "a.toml"
    if text is not None:
        file.write_text(text)
    before = datablocks("objects", "texts")
    refused(bpy.ops.mphdrr.import_phantom, rf"a\.toml.*{message}", filepath=str(file))
    assert datablocks("objects", "texts") == before


@pytest.mark.long
@pytest.mark.parametrize("scale", [(1, 1, 1, 1), (1.2, 0.8, 1, 1)], ids=["turned", "sheared"])
def test_applied_pose_keeps_activity_and_projections(ring_system, scale):
    item = add("shepp-logan", voxels=100, attenuation=True)
    phantom = item.mphdrr_volume.shepp_logan.phantom()
    # Scaled, under a parent that may be scaled too.
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.collection.objects.link(parent)
    parent.matrix_basis = Matrix(euler_pose(0.3, 0.2, 0.1, (3, 4, 5)) @ np.diag(scale))
    item.parent = parent
    item.matrix_basis = Matrix(euler_pose(0.7, 0.4, 0.1, (10, -5, 2)) @ np.diag([0.3, 0.2, 0.25, 1]))
    placed, largest_mu = volumes.pose_of_object(item), voxels_of(item.children[0]).max()
    assert bpy.ops.mphdrr.apply_phantom_pose() == {"FINISHED"}
    volume = volumes.volume_from_object(item)
    assert total(volume) == pytest.approx(phantom.total_activity * np.linalg.det(placed[:3, :3]), rel=1e-3)
    np.testing.assert_allclose(volumes.pose_of_object(item)[:3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(volumes.pose_of_object(item)[:3, 3], placed[:3, 3], atol=1e-5)
    spacing = volume.grid.spacing
    np.testing.assert_allclose(volume.grid.affine[:3, :3], np.diag(spacing), atol=1e-6 * spacing[0])
    mu = volumes.volume_from_object(item.children[0])
    np.testing.assert_allclose(mu.grid.affine, volume.grid.affine, atol=1e-5)
    assert mu.array.max() == pytest.approx(largest_mu)
    assert phantoms.settings_of(item) is None and not bpy.ops.mphdrr.update_phantom.poll()
    views = ring_system.views(shape=(24, 24))
    exact = phantom.project(views, placed)
    baked = Projector(volume.grid, views)(volume)
    assert np.abs(baked - exact).mean() < 0.03 * exact.mean()
    assert baked.sum() == pytest.approx(exact.sum(), rel=5e-3)


def test_moving_the_object_moves_what_is_projected(ring_system):
    item = add("defrise", voxels=48, disks=3)
    item.rotation_euler, item.location, item.scale = (0.4, 0.3, 0.2), (5, 6, -7), (0.5, 0.6, 0.4)
    volume = volumes.volume_from_object(item)
    views = ring_system.views(shape=(24, 24))
    exact = item.mphdrr_volume.defrise.phantom().project(views, volumes.pose_of_object(item))
    found = Projector(volume.grid, views)(volume)
    assert np.abs(found - exact).mean() < 0.05 * exact.mean()


def test_outline_goes_with_the_phantom_and_its_settings():
    item = add("derenzo", voxels=16, **POSE)
    assert bpy.ops.mphdrr.show_phantom_outline() == {"FINISHED"}
    item.mphdrr_volume.derenzo.height = 90
    outline = phantoms.outline_of(item)
    assert outline.display_type == "WIRE" and outline.parent == item
    assert outline.dimensions[2] == pytest.approx(90)
    np.testing.assert_allclose(objects.world_matrix(outline), objects.world_matrix(item), atol=1e-6)
    meshes = len(bpy.data.meshes)
    assert bpy.ops.mphdrr.show_phantom_outline() == {"FINISHED"}
    assert phantoms.outline_of(item) is None and len(bpy.data.meshes) == meshes - 1


@pytest.fixture
def item():
    """Add a phantom of two quantities, 12^3 voxels."""
    bpy.ops.mphdrr.add_shepp_logan(voxels=12, half_size=40, attenuation=True, location=(3, 4, 5))
    return bpy.context.object


@pytest.fixture
def window(monkeypatch):
    """Pretend a window in which every phantom is too large to be made at every edit."""
    monkeypatch.setattr(windows, "has_window", lambda: True)
    monkeypatch.setattr(live_phantoms, "QUICK_VOXELS", 0)


def is_waiting() -> bool:
    return bpy.app.timers.is_registered(live_phantoms._update_edited)


def assert_made(item) -> None:
    """Check that the voxels of every quantity follow from the settings and the object's pose."""
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
    refused(bpy.ops.mphdrr.export_volume, "press Update Phantom first", filepath=str(tmp_path / "a.vdb"))
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
