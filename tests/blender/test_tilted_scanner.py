"""Tilted modules in the scene: their cameras, what is read back, and what follows them."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

import mphdrr.core as mph
from mphdrr.addon.blender import objects
from mphdrr.addon.scanner import cameras, module_edits, scanner, sight_lines
from mphdrr.core.geometry.system import PinholeSystem


@pytest.fixture
def tilted(ring_system, rng) -> PinholeSystem:
    """Modules tilted by up to 3 degrees; one is not."""
    vectors = rng.normal(size=(8, 3))
    vectors *= np.radians(rng.uniform(0.5, 3.0, 8))[:, None] / np.linalg.norm(vectors, axis=1)[:, None]
    vectors[5] = 0.0
    return ring_system.replace(tilt=vectors)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture
def collection(scene, tilted):
    made = scanner.build_scanner(scene, tilted)
    bpy.context.view_layer.update()
    return made


def test_it_is_read_back_exactly_also_from_a_file(collection, tilted, tmp_path):
    assert not collection.mphdrr_scanner.keep_aimed and scanner.losses(collection) == []
    path = str(tmp_path / "tilted.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    for opened in (False, True):
        if opened:
            bpy.ops.wm.open_mainfile(filepath=path)
        read = scanner.read_scanner(scanner.active_scanner(bpy.context.scene))
        for name, values in tilted.values().items():
            assert np.array_equal(read.values()[name], values), name
        assert np.array_equal(read.poses(), tilted.poses())
    found = scanner.modules(scanner.active_scanner(bpy.context.scene))
    assert [camera.mphdrr_module.aimed for camera in found] == [m == 5 for m in range(8)]
    assert not any(camera.mphdrr_module.problem for camera in found)


def test_cameras_see_along_the_rays_of_the_views(scene, collection, tilted):
    views = tilted.views((24, 24))
    i, j = np.divmod(np.arange(24 * 24), 24)
    expected = np.stack([1 - (j + 0.5) / 24, (i + 0.5) / 24], axis=1)
    for m, camera in enumerate(scanner.modules(collection)):
        seen = [world_to_camera_view(scene, camera, Vector(target))[:2] for target in views.rays(m)[1]]
        assert np.allclose(seen, expected, atol=3e-6)


def test_turning_a_camera_tilts_its_module_and_aiming_it_takes_the_tilt(scene, ring_system):
    collection = scanner.build_scanner(scene, ring_system)
    bpy.context.view_layer.update()
    camera = scanner.module(collection, 4)
    before = camera.rotation_euler.copy()
    camera.rotation_euler.y += 0.03
    camera.rotation_euler.x -= 0.02
    bpy.context.view_layer.update()
    read = scanner.read_scanner(collection)
    others = np.arange(8) != 3
    assert not read.tilt[others].any() and 0.03 < np.linalg.norm(read.tilt[3]) < 0.06
    assert np.array_equal(read.centers, ring_system.centers)
    assert np.allclose(read.poses()[3], cameras.module_poses(objects.world_matrix(camera)[None])[0], atol=1e-6)
    assert scanner.losses(collection) == ["module 4 moved or turned"]
    camera.rotation_euler = before
    bpy.context.view_layer.update()
    assert np.array_equal(scanner.read_scanner(collection).tilt, ring_system.tilt)
    camera.rotation_euler.y += 0.03
    assert scanner.aim_modules(collection) == [4]
    assert np.array_equal(scanner.read_scanner(collection).tilt, ring_system.tilt)


def test_a_small_turn_of_a_tilted_module_is_not_lost_and_nothing_drifts(collection, tilted):
    camera = scanner.module(collection, 2)
    camera.rotation_euler.z += 3e-5
    bpy.context.view_layer.update()
    read = scanner.read_scanner(collection)
    assert np.linalg.norm(read.tilt[1] - tilted.tilt[1]) == pytest.approx(3e-5, rel=0.1)
    for _ in range(5):
        bpy.context.view_layer.update()
        assert np.array_equal(scanner.read_scanner(collection).tilt, read.tilt)


def test_a_tilted_module_that_is_only_moved_keeps_its_direction(collection, tilted):
    camera = scanner.module(collection, 2)
    camera.location.z += 4.0
    bpy.context.view_layer.update()
    read = scanner.read_scanner(collection)
    assert np.allclose(read.frames()[1], tilted.frames()[1], rtol=0, atol=1e-12)
    collection.mphdrr_scanner.keep_aimed = True
    camera.location.z += 1.0
    bpy.context.view_layer.update()
    assert not scanner.read_scanner(collection).tilt[1].any()
    assert np.array_equal(np.delete(scanner.read_scanner(collection).tilt, 1, 0), np.delete(tilted.tilt, 1, 0))


def test_copies_along_the_ring_keep_the_tilt(collection, tilted):
    for follow_ring in (False, True):
        (copy,) = module_edits.duplicate_modules(
            collection, [scanner.module(collection, 3)], 1, 0.21 + follow_ring / 10, follow_ring
        )
        assert np.allclose(scanner.read_module(collection, copy).tilt, tilted.tilt[2], rtol=0, atol=1e-12)


def test_readouts_lines_of_sight_and_parts_are_of_the_tilted_module(scene, collection, tilted):
    module = scanner.module(collection, 1).mphdrr_module
    assert module.sensitivity == pytest.approx(1e6 * mph.sensitivity(tilted, np.zeros((1, 3)))[0, 0], rel=1e-6)
    assert module.roi_seen == pytest.approx(tilted.roi_radius_seen()[0], rel=1e-6)
    state = scene.mphdrr_geometry
    state.show_rays = state.sight_all = True
    ends = sight_lines.lines(bpy.context)["show_rays"]
    along = ends[:, 1] - ends[:, 0]
    assert np.allclose(along / np.linalg.norm(along, axis=1)[:, None], tilted.principal_rays, atol=1e-6)
    for part in tilted.parts():
        item = next(
            o
            for o in scene.objects
            if o.mphdrr_module.part == part.kind.upper() and o.mphdrr_module.number == part.number
        )
        points = np.array([item.matrix_world @ v.co for v in item.data.vertices])
        assert np.allclose(points, part.vertices, atol=1e-4)
