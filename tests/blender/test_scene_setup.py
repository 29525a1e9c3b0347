"""A clean scene: scanners removed whole, cameras that were edited, units and views, lines of sight."""

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from mphdrr.addon.pictures import planes
from mphdrr.addon.scanner import framing, scanner, sight_lines
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.volumes.volume import Volume

from .conftest import Drawn, datablocks, update


def names() -> dict[str, list[str]]:
    return datablocks("objects", "meshes", "cameras", "materials", "collections", "images")


def views() -> list[tuple]:
    return [framing._state(space) for _, _, space in framing._spaces()]


def test_a_removed_scanner_leaves_nothing_of_its_own(scene, ring_system):
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 2.0), "activity"), "Box")
    other = scanner.build_scanner(scene, ring_system[0:2], "Other")
    before = names()
    collection = scanner.build_scanner(scene, ring_system, "One")
    bpy.ops.mphdrr.render_projections(width=8, height=8)
    update()
    images = names()["images"]
    mine, marker = (bpy.data.objects.new(name, None) for name in ("Mine", "On a module"))
    collection.children[0].objects.link(mine)
    scene.collection.objects.link(marker)
    marker.parent = scanner.module(collection, 4)
    marker.location.z = -20.0
    copy = scanner.module(collection, 5).copy()
    collection.children[1].objects.link(copy)
    update()
    place = marker.matrix_world.translation.copy()

    assert scanner.active_scanner(scene) == collection
    assert bpy.ops.mphdrr.remove_scanner() == {"FINISHED"}
    update()
    before["objects"] = sorted([*before["objects"], "Mine", "On a module"])
    assert names() == before | {"images": images}, "a run stays"
    assert list(mine.users_collection) == [scene.collection]
    assert np.allclose(marker.matrix_world.translation, place, atol=1e-4) and marker.parent is None
    assert scanner.active_scanner(scene) == other and not planes.planes(scene)

    bpy.ops.mphdrr.remove_scanner()
    assert not [name for name in names()["materials"] if name.startswith("mphDRR")]
    assert not bpy.ops.mphdrr.remove_scanner.poll()


def test_cameras_that_were_edited_are_named_until_they_are_reset(ring, monkeypatch):
    camera = scanner.module(ring, 3)

    def said() -> str:
        return " ".join(map(str, Drawn("MPHDRR_PT_design").calls))

    assert "reset_cameras" not in said()
    edits = {"lens": 77.0, "sensor_width": 30.0, "shift_x": 0.1, "sensor_fit": "VERTICAL", "type": "ORTHO"}
    for name, value in edits.items():
        setattr(camera.data, name, value)
        update()
        assert "reset_cameras" in said() and "of 1 camera" in said(), name
        assert bpy.ops.mphdrr.reset_cameras() == {"FINISHED"}
        assert "reset_cameras" not in said(), name
        ratio = camera.mphdrr_module.collimator_length / camera.mphdrr_module.detector_side
        assert camera.data.lens / camera.data.sensor_width == pytest.approx(ratio, rel=1e-6)
    camera.data.lens = 77.0
    camera.mphdrr_module.collimator_length = 61.0
    assert camera.data.lens == pytest.approx(61.0), "it follows l"


def test_a_scene_of_other_units_is_set_up(scene, ring, ring_system):
    scene.unit_settings.scale_length = 1.0
    for _, _, space in framing._spaces():
        space.clip_end, space.region_3d.view_distance = 100.0, 10.0
    assert not scanner.is_set_up(scene)
    bpy.ops.mphdrr.set_up_scene()
    assert scanner.is_set_up(scene)
    reach = max(np.linalg.norm(ring_system.centers, axis=1) + ring_system.collimator_length)
    spaces = [space for _, _, space in framing._spaces()]
    assert spaces and all(s.clip_end > 10 * reach for s in spaces)
    turned = [s.region_3d.view_distance > reach for s in spaces if s.region_3d.view_perspective != "CAMERA"]
    assert turned and all(turned)
    assert ring == scanner.active_scanner(scene)


def test_views_follow_the_undo_of_an_import_unless_they_were_turned(scene, ring_system):
    before = views()
    ring = scanner.build_scanner(scene, ring_system)
    after = views()
    assert all(a != b for a, b in zip(before, after, strict=True))

    def undo(is_scanner: bool) -> None:
        framing.before_undo()
        ring.mphdrr_scanner.is_scanner = is_scanner
        framing.after_undo()

    undo(True)  # of something else
    assert views() == after
    undo(False)
    assert views() == before
    undo(False)
    undo(True)
    assert views() == after
    turned = next(space for _, _, space in framing._spaces() if space.region_3d.view_perspective != "CAMERA")
    turned.region_3d.view_distance += 1.0
    undo(False)
    assert framing._state(turned) not in before
    assert sum(a != b for a, b in zip(views(), before, strict=True)) == 1


def test_lines_of_sight_are_those_of_the_cameras(scene, ring, ring_system):
    bpy.context.view_layer.objects.active = scanner.module(ring, 3)
    update()
    state = scene.mphdrr_geometry
    assert sight_lines.lines(bpy.context) == {}
    state.show_rays = state.show_frustums = state.show_detectors = True
    (ray,) = sight_lines.lines(bpy.context)["show_rays"]
    views_ = ring_system.views((16, 16), magnification=scene.mphdrr_projections.magnification)
    assert np.allclose(ray, [views_.sources[2], views_.detector_centers[2]], atol=1e-3)
    state.sight_all = True
    scanner.show_modules(ring, "2-8")
    update()
    drawn = sight_lines.lines(bpy.context)
    assert [len(drawn[name]) for name in ("show_rays", "show_frustums", "show_detectors")] == [7, 28, 28]
    for m, camera in enumerate(scanner.modules(ring)[1:]):
        seen = [world_to_camera_view(scene, camera, Vector(p)) for p in drawn["show_detectors"][4 * m : 4 * m + 4, 0]]
        ends = sorted(p[:2] for p in np.round(seen, 3).tolist())
        assert np.allclose(ends, [(0, 0), (0, 1), (1, 0), (1, 1)], atol=2e-3)
        assert np.allclose([p.z for p in seen], 10 * camera.mphdrr_module.collimator_length, rtol=1e-5)
