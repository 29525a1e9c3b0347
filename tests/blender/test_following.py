"""Modules follow the parts that are grabbed, and the panels the scanner whose part is selected."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from mphdrr.addon.blender import ids, objects
from mphdrr.addon.pictures import images, planes, tiles
from mphdrr.addon.scanner import grabbing, live_scanner, scanner, selection
from mphdrr.addon.volumes import volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.volumes.volume import Volume

from .conftest import assert_same, move, part, reopened, select, update

MOTION = Matrix.Translation((4.0, -9.0, 6.5)) @ Euler((0.1, -0.2, 0.3)).to_matrix().to_4x4()


@pytest.fixture
def box(scene) -> None:
    """Add a small volume of activity in the middle of the scene."""
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 2.0), "activity"), "Box")


@pytest.fixture
def collection(ring, box):
    ring.mphdrr_scanner.keep_aimed = False
    bpy.ops.mphdrr.render_projections(width=8, height=6)
    update()
    return ring


@pytest.mark.parametrize("name", ["COLLIMATOR", "CRYSTAL", "PLANE"])
def test_the_module_goes_where_a_part_is_put(collection, name):
    camera = scanner.module(collection, 3)
    scanner_before = scanner.read_scanner(collection)
    item, before, numbers = part(camera, name), camera.matrix_world.copy(), scanner_before.centers
    local = item.matrix_basis.copy()
    item.matrix_world = MOTION @ item.matrix_world
    for _ in range(3):  # what the handler writes is an update again
        update()
    assert np.allclose(camera.matrix_world, MOTION @ before, atol=1e-4)
    assert np.allclose(item.matrix_parent_inverse @ item.matrix_basis, local, atol=1e-6), "it stays on its module"
    after = scanner.read_scanner(collection)
    motion = np.array(MOTION)[:3, :3]
    assert np.allclose(after.frames()[2], scanner_before.frames()[2] @ motion.T, atol=1e-6), "tilted as the part was"
    assert after.centers[2] == pytest.approx(list(MOTION @ before.translation), abs=1e-4)
    assert np.array_equal(np.delete(after.centers, 2, 0), np.delete(numbers, 2, 0))
    collection.mphdrr_scanner.keep_aimed = True
    move(item, z=2.0)
    assert camera.mphdrr_module.aimed and scanner.unaimed_numbers(collection, [camera]) == []


def test_a_drag_goes_from_where_it_began(collection, monkeypatch):
    """Blender's tools write the part's own place anew with each motion of the mouse, and once more if they are cancelled."""
    collection.mphdrr_scanner.keep_aimed = True
    camera = scanner.module(collection, 5)
    start, items = camera.matrix_world.copy(), [part(camera, name) for name in ("CRYSTAL", "COLLIMATOR")]
    monkeypatch.setattr(grabbing, "is_dragging", lambda: True)

    def drag(by: float) -> None:
        for item in items:
            item.location.y = by
        for _ in range(2):
            update()
        assert np.allclose(camera.location, start @ Matrix.Translation((0, by, 0)).translation, atol=1e-4)
        assert camera.mphdrr_module.aimed
        assert all(np.allclose(item.matrix_world, camera.matrix_world, atol=1e-4) for item in items)

    for by in (0.5, 7.0, 12.0):
        drag(by)
    place = camera.matrix_world.copy()
    live_scanner.after_undo()  # as at the end of the drag
    update()
    assert np.allclose(camera.matrix_world, place, atol=1e-5) and camera.mphdrr_module.aimed
    assert all(np.array_equal(item.matrix_basis, np.eye(4)) and not grabbing.is_dragged(item) for item in items)
    start = place
    drag(3.0)
    drag(0.0)
    assert np.allclose(camera.matrix_world, start, atol=1e-4)


def test_an_undo_step_taken_before_the_last_motion_was_seen(collection, monkeypatch):
    camera = scanner.module(collection, 5)
    start, item = camera.matrix_world.copy(), part(camera, "CRYSTAL")
    monkeypatch.setattr(grabbing, "is_dragging", lambda: True)
    item.location.y = 3.0
    update()
    item.location.y = 11.0
    live_scanner.after_undo()
    assert np.allclose(camera.location, start @ Matrix.Translation((0, 11, 0)).translation, atol=1e-4)
    item.location.y = 40.0  # and here none was seen: the next step has where the module went
    place = camera.location.copy()
    live_scanner.after_undo()
    update()
    assert camera.location == place and np.array_equal(item.matrix_basis, np.eye(4))


def test_what_is_locked_animated_copied_or_moved_itself_is_respected(scene, collection):
    camera = scanner.module(collection, 2)
    item, place = part(camera, "CRYSTAL"), camera.location.copy()
    camera.lock_location = (False, False, True)
    item.matrix_world = Matrix.Translation((1, 2, 3)) @ item.matrix_world
    update()
    assert np.allclose(camera.location - place, (1, 2, 0), atol=1e-4)
    assert np.array_equal(item.matrix_basis, np.eye(4))

    camera.lock_location = (False, False, False)
    place = camera.location.copy()
    for moved in (camera, *camera.children):
        moved.location.x += 5.0
    update()
    update()
    assert np.allclose(camera.location - place, (5, 0, 0), atol=1e-4)

    camera.keyframe_insert("location", frame=1)
    place = camera.location.copy()
    move(item, x=5.0)
    assert camera.location == place and np.array_equal(item.matrix_basis, np.eye(4))

    other = scanner.module(collection, 6)
    copy = part(other, "COLLIMATOR").copy()
    other.users_collection[0].objects.link(copy)
    place = objects.world_matrix(other)
    move(copy, x=20.0)
    assert np.array_equal(objects.world_matrix(other), place) and copy.location.x == 20.0
    assert planes.planes(scene)


def test_parts_that_version_0_1_0_locked_are_freed_and_the_users_locks_stay(collection, tmp_path):
    item = part(scanner.module(collection, 1), "CRYSTAL")
    for was_free in (False, True):
        item.lock_location, collection.mphdrr_scanner.parts_free = (True, True, True), was_free
        collection = scanner.active_scanner(reopened(tmp_path / "old.blend"))
        item = part(scanner.module(collection, 1), "CRYSTAL")
        assert tuple(item.lock_location) == (was_free,) * 3


@pytest.fixture
def a_and_b(scene, ring_system):
    made = [scanner.build_scanner(scene, ring_system, "A"), scanner.build_scanner(scene, ring_system[2:7], "B")]
    update()
    return made


def shown(scene: bpy.types.Scene) -> tuple[str, int, int]:
    """Return the panels' scanner, and the numbers of its listed and active modules."""
    listed, active = selection.listed_module(scene), selection.active_module(bpy.context)
    return scanner.active_scanner(scene).name, listed.mphdrr_module.number, active.mphdrr_module.number


def test_the_panels_follow_the_selection(scene, a_and_b):
    a, b = a_and_b
    assert shown(scene) == ("B", 3, 3), "the new one"
    select(scanner.module(a, 6))
    assert shown(scene) == ("A", 6, 6)
    select(part(scanner.module(b, 5), "CRYSTAL"))
    assert shown(scene) == ("B", 5, 5)
    select(next(o for o in a.objects if o.mphdrr_module.part == "ROI"))
    assert shown(scene)[0] == "A"
    select(scene.objects["Cube"])
    assert shown(scene)[0] == "A", "no scanner's"
    scene.mphdrr_geometry.scanner = b
    update()
    assert shown(scene) == ("B", 3, 3), "what is chosen in the panel stays chosen"
    scene.mphdrr_geometry.active_index = b.all_objects.find(scanner.module(b, 7).name)
    update()
    assert shown(scene) == ("B", 7, 7) and bpy.context.selected_objects == [scanner.module(b, 7)]
    scanner.show_modules(a, "5-5")
    scene.mphdrr_geometry.scanner = a
    scene.mphdrr_geometry.active_index = a.all_objects.find(scanner.module(a, 8).name)
    update()
    assert shown(scene) == ("A", 8, 8), "also a module that is hidden"


def test_each_edit_changes_the_selected_one(scene, a_and_b):
    for mine, other in (a_and_b, a_and_b[::-1]):
        before = scanner.read_scanner(other)
        select(part(scanner.module(mine, 4), "COLLIMATOR"))
        panel = scanner.active_scanner(scene)
        panel.mphdrr_scanner.detector_thickness = 7.5
        selection.active_module(bpy.context).mphdrr_module.pinhole_diameter = 3.5
        bpy.ops.mphdrr.show_modules(modules="4-5", mode="ONLY")
        bpy.ops.mphdrr.duplicate_modules(count=1, angle=np.radians(14))
        select(scanner.module(mine, 5))
        bpy.ops.mphdrr.remove_modules()
        now = scanner.read_scanner(mine)
        assert 5 not in now.numbers and (now.detector_thickness == 7.5).all() and 3.5 in now.pinhole_diameter
        assert_same(scanner.read_scanner(other), before)
        mine.mphdrr_scanner.detector_thickness = 9.5
        scanner.show_modules(mine, mode="ALL")


def test_a_run_belongs_to_its_scanner(scene, a_and_b, box):
    a, b = a_and_b
    select(scanner.module(a, 1))
    bpy.ops.mphdrr.render_projections(width=8, height=8)
    select(scanner.module(b, 6))
    mosaic = bpy.data.images[ids.MOSAIC]
    scene.mphdrr_display.colors = "GREY"  # made anew
    assert images.scanner_of(mosaic) == a
    assert {plane.parent for plane in planes.planes(scene)} == set(scanner.modules(a))

    found = images.tiles(mosaic)
    row, column = np.reshape(found["corners"], (-1, 2))[found["numbers"].index(6)]
    width, height = mosaic.size
    assert tiles.active_tile(bpy.context, mosaic) is None, "module 6 of B has no image here"
    view = SimpleNamespace(region_to_view=lambda x, y: (x, y))
    context = SimpleNamespace(
        space_data=SimpleNamespace(image=mosaic), region=SimpleNamespace(view2d=view), scene=scene,
        view_layer=bpy.context.view_layer, mode="OBJECT",
    )  # fmt: skip
    place = (column + 3) / width, 1 - (row + 3) / height
    assert tiles.pick_module(context, *place) == scanner.module(a, 6).name
    update()
    assert shown(scene) == ("A", 6, 6) and tiles.active_tile(bpy.context, mosaic) == found["numbers"].index(6)
    bpy.data.collections.remove(a)
    with pytest.raises(InputError, match="not in the scene"):
        tiles.pick_module(context, *place)


@pytest.mark.parametrize("number", [np.nan, np.inf, 1e30])
def test_numbers_that_no_one_can_type_end_in_a_line(ring, capfd, number):
    camera = scanner.module(ring, 5)
    for owner, name in ((camera, "location"), (camera, "rotation_euler"), (ring.mphdrr_scanner, "intrinsic_fwhm")):
        before = np.array(getattr(owner, name)).tolist()
        setattr(owner, name, (number,) * 3 if isinstance(before, list) else number)
        update()
        if not np.isfinite(getattr(owner, name)).all():
            assert "is not a finite number" in camera.mphdrr_module.problem, name
        setattr(owner, name, before)
        update()
        assert not camera.mphdrr_module.problem, name
    assert "Traceback" not in capfd.readouterr().err
