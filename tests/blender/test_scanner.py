"""The scanner in the scene: built, replaced, changed and read back."""

from __future__ import annotations

import subprocess
import sys

import bpy
import numpy as np
import pytest

from mphdrr.addon import registration
from mphdrr.addon.blender import objects
from mphdrr.addon.scanner import cameras, scanner
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.collimator import Construction

from .conftest import assert_same, datablocks, reopened, update

KINDS = ("objects", "meshes", "cameras", "materials", "collections")


def test_registers_twice_and_its_handlers_come_and_go_once():
    lists = {id(handlers): handlers for handlers, _ in registration.HANDLERS}.values()
    lengths = [len(handlers) for handlers in lists]
    for _ in range(3):
        registration.unregister()
        assert [len(handlers) for handlers in lists] != lengths
        assert not hasattr(bpy.types.Object, "mphdrr_module") and not hasattr(bpy.types, "MPHDRR_PT_geometry")
        registration.register()
        assert [len(handlers) for handlers in lists] == lengths


def test_failed_registration_leaves_nothing(monkeypatch):
    registration.unregister()

    class Broken(bpy.types.Operator):
        bl_idname = "no_dot_in_it"
        bl_label = "Broken"

    monkeypatch.setattr(registration, "CLASSES", (*registration.CLASSES, Broken))
    with pytest.raises((RuntimeError, ValueError), match="no_dot_in_it"):
        registration.register()
    assert not hasattr(bpy.types.Object, "mphdrr_module")
    monkeypatch.undo()
    registration.register()


def test_scanner_has_a_collection_per_ring_and_a_camera_per_module(scene, dc_spect):
    collection = scanner.build_scanner(scene, dc_spect)
    assert [c.name for c in collection.children] == ["Ring 1", "Ring 2", "Ring 3", "Ring 4"]
    assert [len(c.objects) for c in collection.children] == [60] * 4
    found = scanner.modules(collection)
    assert [o.name for o in found[:2]] == ["Module 01", "Module 02"]
    assert [o.mphdrr_module.number for o in found] == list(range(1, 81))
    assert scene.unit_settings.scale_length == pytest.approx(0.001)
    assert scanner.quick_ranges(dc_spect.numbers, dc_spect.rings()) == ["1-40", "21-60", "41-80"]
    assert scanner.suggested_ranges(None, bpy.context, "") == ["1-40", "21-60", "41-80"]
    assert sum(o.type == "MESH" for o in collection.all_objects) == 161
    meshes = {o.data for o in collection.all_objects if o.type == "MESH"}
    assert len(meshes) == 161, "each has its own, which is reshaped in place"


def test_camera_axes_follow_the_module_frame(scene, ring_system):
    found = scanner.modules(scanner.build_scanner(scene, ring_system))
    update()
    for camera, (u, v, k), center in zip(found, ring_system.frames(), ring_system.centers, strict=True):
        matrix = np.array(camera.matrix_world)
        assert np.allclose(matrix[:3, :3], np.stack([-u, v, -k], axis=1), atol=5e-7)
        assert np.allclose(matrix[:3, 3], center, atol=2e-5)
        assert camera.rotation_euler.y == 0.0


def test_unchanged_scanner_reads_back_exactly_also_from_a_file(scene, ring_system, dc_spect, tmp_path):
    for system in (ring_system, ring_system[np.array([5, 0, 7, 2])]):  # unsorted numbers keep their order
        assert_same(scanner.read_scanner(scanner.build_scanner(scene, system, "A", replace=True)), system)
    scanner.build_scanner(scene, dc_spect)
    update()
    for is_reopened in (False, True):
        if is_reopened:
            scene = reopened(tmp_path / "scanner.blend")
        collection = scanner.active_scanner(scene)
        back = scanner.read_scanner(collection)
        assert_same(back, dc_spect)
        assert back.source == dc_spect.source and scanner.losses(collection) == []


def test_moved_camera_and_edited_number_are_read(ring, ring_system):
    third = scanner.module(ring, 3)
    third.location.z += 5.0
    scanner.module(ring, 4).mphdrr_module.pinhole_diameter = 3.0
    back = scanner.read_scanner(ring)
    assert np.allclose(back.centers[2], ring_system.centers[2] + [0, 0, 5], atol=2e-5)
    assert np.array_equal(np.delete(back.centers, 2, axis=0), np.delete(ring_system.centers, 2, axis=0))
    assert back.pinhole_diameter.tolist() == [2.3, 2.3, 2.3, 3.0, 2.3, 2.3, 2.3, 2.3]
    assert back.source is None
    assert not back.tilt.any() and scanner.aim_modules(ring) == []
    assert np.allclose(objects.world_matrix(third), cameras.camera_matrices(back.poses())[2], atol=2e-5)


def test_hidden_or_parented_camera_is_read_where_it_is(scene, ring, ring_system):
    scanner.show_modules(ring, "1-1", "ONLY")
    update()
    bench = bpy.data.objects.new("Bench", None)
    scene.collection.objects.link(bench)
    bench.location = (0, 0, 12.5)
    for camera in scanner.modules(ring):
        camera.parent = bench
    back = scanner.read_scanner(ring)
    assert np.allclose(back.centers, ring_system.centers + np.array([0, 0, 12.5]), atol=5e-5)


def test_importing_again_leaves_no_orphans(scene, ring, ring_system):
    before = datablocks(*KINDS)
    for _ in range(2):
        scanner.build_scanner(scene, ring_system, "Ring")
    assert datablocks(*KINDS) == before and all(mesh.users for mesh in bpy.data.meshes)


def test_scanners_of_different_names_coexist(scene, ring_system):
    one = scanner.build_scanner(scene, ring_system, "One")
    two = scanner.build_scanner(scene, ring_system[0:3], "Two")
    assert scanner.scanners(scene) == [one, two]
    assert scanner.active_scanner(scene) == two
    assert (len(scanner.read_scanner(one)), len(scanner.read_scanner(two))) == (8, 3)
    scanner.build_scanner(scene, ring_system[0:2], "One")
    assert (len(scanner.read_scanner(one)), len(scanner.read_scanner(two))) == (2, 3)


def test_replacing_asks_for_what_would_be_lost_and_keeps_what_is_the_users(scene, ring_system):
    collection = scanner.build_scanner(scene, ring_system, "One")
    camera = scanner.module(collection, 5)
    own = bpy.data.objects.new("My lamp", None)
    collection.objects.link(own)
    on_module = bpy.data.objects.new("My marker", None)
    scene.collection.objects.link(on_module)
    on_module.parent = scanner.module(collection, 8)
    copy = camera.copy()
    collection.children[0].objects.link(copy)
    folder = bpy.data.collections.new("My folder")
    collection.children[1].children.link(folder)
    camera.location.x += 1.0
    scanner.module(collection, 6).mphdrr_module.detector_side = 47.0
    scene.camera = camera

    before = datablocks(*KINDS)
    with pytest.raises(InputError) as error:
        scanner.build_scanner(scene, ring_system, "One")
    assert datablocks(*KINDS) == before
    for phrase in ("module 5 moved", "module 6 with changed", "My lamp", "My folder", copy.name, "replace=True"):
        assert phrase in str(error.value)
    assert "\n" not in str(error.value)

    again = scanner.build_scanner(scene, ring_system[0:6], "One", replace=True)
    assert again == collection
    assert_same(scanner.read_scanner(again), ring_system[0:6])
    update()
    place = np.array(on_module.matrix_world)[:3, 3]
    assert np.allclose(place, ring_system.centers[7], atol=2e-5), "its module has gone: it stays where it was"
    for item in (own, on_module, copy):
        assert list(item.users_collection) == [scene.collection]
    assert folder in list(scene.collection.children)
    assert scene.camera == scanner.module(again, 5)
    assert scanner.losses(again) == []


def test_deleted_module_is_named_as_a_loss_and_two_of_one_number_are_refused(ring):
    copy = scanner.module(ring, 2).copy()
    ring.objects.link(copy)
    with pytest.raises(InputError, match=r"'Module 02' and 'Module 02.001' both have module number 2"):
        scanner.read_scanner(ring)
    bpy.data.objects.remove(copy)
    bpy.data.objects.remove(scanner.module(ring, 2))
    assert scanner.losses(ring) == ["1 module deleted or moved out"]
    assert scanner.read_scanner(ring).numbers.tolist() == [1, 3, 4, 5, 6, 7, 8]


def test_failed_build_leaves_the_scene_as_it_was(scene, ring, ring_system, monkeypatch):
    before = datablocks(*KINDS)
    with pytest.raises(InputError, match="aperture plate"):
        scanner.build_scanner(scene, ring_system, "Ring", construction=Construction(60.0))
    monkeypatch.setattr(cameras, "set_field_of_view", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        scanner.build_scanner(scene, ring_system, "Other")
    assert datablocks(*KINDS) == before


def test_modules_are_shown_by_range(scene, ring, ring_system):

    def visible() -> list[int]:
        shown = []
        for camera in scanner.modules(ring):
            states = {item.hide_viewport for item in (camera, *camera.children)}
            assert states == {item.hide_render for item in (camera, *camera.children)} and len(states) == 1
            if not camera.hide_viewport:
                shown.append(camera.mphdrr_module.number)
        return shown

    assert scanner.show_modules(ring, "2-4") == 3
    assert visible() == [2, 3, 4]
    scanner.show_modules(ring, "7-9", "SHOW")
    assert visible() == [2, 3, 4, 7, 8]
    scanner.show_modules(ring, "1-3", "HIDE")
    assert visible() == [4, 7, 8]
    scanner.module(ring, 4).mphdrr_module.visible = False
    assert visible() == [7, 8]
    scanner.build_scanner(scene, ring_system, "Ring")
    assert visible() == [7, 8], "importing again keeps what is hidden"
    scanner.show_modules(ring, mode="ALL")
    assert visible() == list(range(1, 9))
    with pytest.raises(InputError, match="no module 9-20; there are 1 to 8"):
        scanner.show_modules(ring, "9-20")


def test_the_modules_that_are_visible_are_one_text(scene, ring):
    state = scene.mphdrr_geometry

    def visible():
        return [camera.mphdrr_module.number for camera in scanner.modules(ring) if not camera.hide_viewport]

    assert state.visible == ""
    state.visible = "2-4, 7"
    assert visible() == [2, 3, 4, 7] and state.visible == "2-4, 7"
    scanner.module(ring, 3).mphdrr_module.visible = False
    assert state.visible == "2, 4, 7", "what is shown, however it came so"
    for text, reason in (
        ("9-20", "no module 9-20; there are 1 to 8"),
        ("a", "expected numbers such as 1-40 or 1-20,41"),
    ):
        state.visible = text
        assert reason in state.visible_problem and visible() == [2, 4, 7]
    state.visible = ""
    assert visible() == list(range(1, 9)) and (state.visible, state.visible_problem) == ("", "")
    scanner.show_modules(ring, mode="HIDE")
    assert state.visible == "none"


@pytest.mark.long
def test_python_ends_with_the_extension_registered():
    """Blender 4.5's module hangs if classes are still registered when Python ends."""
    script = "from mphdrr.addon import registration as r; r.register(); r.unregister(); r.register()"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=600)


def test_numbers_that_are_animated_or_driven_are_followed(scene, ring):
    keyed, driven = (scanner.module(ring, number) for number in (1, 2))
    usual = [camera.mphdrr_module.sensitivity for camera in (keyed, driven)]
    for frame, diameter in ((1, 2.3), (10, 4.6)):
        keyed.mphdrr_module.pinhole_diameter = diameter
        keyed.mphdrr_module.keyframe_insert("pinhole_diameter", frame=frame)
    for frame, ratio in ((1, 1.0), (10, 4.0)):
        scene.frame_set(frame)
        assert keyed.mphdrr_module.sensitivity == pytest.approx(ratio * usual[0], rel=1e-5)
    driver = driven.driver_add("mphdrr_module.pinhole_diameter").driver
    variable = driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id = bpy.data.objects["Cube"]
    driver.expression = f"2.3 + {variable.name}"
    bpy.data.objects["Cube"].location.x = 2.3
    update()
    assert driven.mphdrr_module.sensitivity == pytest.approx(4 * usual[1], rel=1e-5)
