"""Blender's cameras, tilted ones too, agree with `Views`: by Blender's own projection, and by Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

import mphdrr.core as mph
from mphdrr.addon.blender import objects
from mphdrr.addon.scanner import cameras, module_edits, scanner, sight_lines
from mphdrr.core.geometry.collimator import Construction
from mphdrr.core.geometry.system import PinholeSystem
from mphdrr.core.geometry.views import Views

from .conftest import assert_same, cycles_picture, move, reopened, turn, update


def project(views: Views, points: np.ndarray) -> np.ndarray:
    """Return columns and rows (M, N, 2) of world points (N, 3)."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    image = np.einsum("mij,nj->mni", views.projection_matrices(), homogeneous)
    return image[..., :2] / image[..., 2:]


def assert_blender_agrees(scene, collection, views: Views) -> None:
    update()
    inside_roi = scanner.modules(collection)[0].mphdrr_module.roi_radius / np.sqrt(3)
    points = np.random.default_rng(1).uniform(-inside_roi, inside_roi, (40, 3))
    for camera, expected in zip(scanner.modules(collection), project(views, points), strict=True):
        x, y = np.transpose([world_to_camera_view(scene, camera, Vector(point))[:2] for point in points])
        pixels = np.stack([(1 - x) * views.shape[1] - 0.5, y * views.shape[0] - 0.5], axis=1)  # x is along -u
        assert np.abs(pixels - expected).max() < 1e-3


@pytest.mark.parametrize("shape", [(256, 256), (128, 200)])
def test_all_modules_project_as_their_views(scene, dc_spect, shape):
    collection = scanner.build_scanner(scene, dc_spect, shape=shape)
    assert_blender_agrees(scene, collection, dc_spect.views(shape=shape))


def test_modules_smaller_than_blenders_smallest_camera(scene):
    """Lens and sensor below 1 are silently clamped by Blender: both are scaled up."""
    system = PinholeSystem([[30.0, 4.0, 5.0], [-3.0, 40.0, -6.0]], 0.1, [0.4, 0.8], 0.5, 1.0, 5.0)
    collection = scanner.build_scanner(scene, system, construction=Construction(0.1, 0.1))
    assert all(c.data.lens >= 1.0 and c.data.sensor_width >= 1.0 for c in scanner.modules(collection))
    assert_blender_agrees(scene, collection, system.views())


def test_module_on_the_axis(scene):
    """Where the principal ray is parallel to z, u comes from the x axis."""
    system = PinholeSystem([[0.0, 0.0, 200.0], [0.0, 0.0, -220.0]], 2.3, 55.0, 50.0, 10.0, 60.0)
    assert_blender_agrees(scene, scanner.build_scanner(scene, system), system.views())


@pytest.mark.parametrize("number", [14, 47])
def test_markers_rendered_by_cycles_land_where_views_say(scene, dc_spect, number):
    """Not mirrored and not upside down: the markers differ in size and have no symmetry."""
    shape = (96, 128)
    collection = scanner.build_scanner(scene, dc_spect, shape=shape)
    for item in list(scene.objects):
        if item.type in {"LIGHT", "MESH"} and item.mphdrr_module.part == "NONE":
            bpy.data.objects.remove(item)
    markers = np.array([[28.0, 6.0, 35.0], [-17.0, 30.0, -22.0], [9.0, -31.0, 12.0]])
    for channel, center in enumerate(markers):  # red, green, blue
        add_emitting_sphere(center, 2.5, channel)
    scene.camera = scanner.module(collection, number)
    as_arrays = cycles_picture(scene, samples=4)[:, ::-1]  # pictures have -u to the right; rows already grow along +v
    expected = project(dc_spect.views(shape=shape)[number - 1], markers)[0]
    for channel in range(3):
        weight = as_arrays[:, :, channel] * (as_arrays[:, :, channel] > 0.2)
        assert weight.sum() > 0
        rows, columns = np.indices(weight.shape)
        got = [(columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()]
        assert np.abs(np.array(got) - expected[channel]).max() < 1.0


def add_emitting_sphere(center: np.ndarray, radius: float, channel: int) -> None:
    """Add a sphere to the scene that is bright in one channel of colour."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=3, radius=radius, location=center)
    material = bpy.data.materials.new("Marker")
    if material.node_tree is None:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = [float(i == channel) for i in range(3)] + [1.0]
    material.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    bpy.context.object.data.materials.append(material)


@pytest.fixture
def tilted(ring_system) -> PinholeSystem:
    """Return modules tilted by up to 3 degrees; one is not."""
    rng = np.random.default_rng(5)
    vectors = rng.normal(size=(8, 3))
    vectors *= np.radians(rng.uniform(0.5, 3.0, 8))[:, None] / np.linalg.norm(vectors, axis=1)[:, None]
    vectors[5] = 0.0
    return ring_system.replace(tilt=vectors)


@pytest.fixture
def collection(scene, tilted):
    made = scanner.build_scanner(scene, tilted)
    update()
    return made


def test_it_is_read_back_exactly_also_from_a_file(collection, tilted, tmp_path):
    assert not collection.mphdrr_scanner.keep_aimed and scanner.losses(collection) == []
    for is_reopened in (False, True):
        if is_reopened:
            collection = scanner.active_scanner(reopened(tmp_path / "tilted.blend"))
        read = scanner.read_scanner(collection)
        assert_same(read, tilted)
        assert np.array_equal(read.poses(), tilted.poses())
    found = scanner.modules(collection)
    assert [camera.mphdrr_module.aimed for camera in found] == [m == 5 for m in range(8)]
    assert not any(camera.mphdrr_module.problem for camera in found)


def test_cameras_see_along_the_rays_of_the_views(scene, collection, tilted):
    views = tilted.views((24, 24))
    i, j = np.divmod(np.arange(24 * 24), 24)
    expected = np.stack([1 - (j + 0.5) / 24, (i + 0.5) / 24], axis=1)
    for m, camera in enumerate(scanner.modules(collection)):
        seen = [world_to_camera_view(scene, camera, Vector(target))[:2] for target in views.rays(m)[1]]
        assert np.allclose(seen, expected, atol=3e-6)


def test_turning_a_camera_tilts_its_module_and_aiming_it_takes_the_tilt(ring, ring_system):
    camera = scanner.module(ring, 4)
    before = camera.rotation_euler.copy()
    turn(camera, y=0.03, x=-0.02)
    read = scanner.read_scanner(ring)
    others = np.arange(8) != 3
    assert not read.tilt[others].any() and 0.03 < np.linalg.norm(read.tilt[3]) < 0.06
    assert np.array_equal(read.centers, ring_system.centers)
    assert np.allclose(read.poses()[3], cameras.module_poses(objects.world_matrix(camera)[None])[0], atol=1e-6)
    assert scanner.losses(ring) == ["module 4 moved or turned"]
    camera.rotation_euler = before
    update()
    assert np.array_equal(scanner.read_scanner(ring).tilt, ring_system.tilt)
    camera.rotation_euler.y += 0.03
    assert scanner.aim_modules(ring) == [4]
    assert np.array_equal(scanner.read_scanner(ring).tilt, ring_system.tilt)


def test_a_small_turn_of_a_tilted_module_is_not_lost_and_nothing_drifts(collection, tilted):
    camera = scanner.module(collection, 2)
    camera.rotation_euler.z += 3e-5
    update()
    read = scanner.read_scanner(collection)
    assert np.linalg.norm(read.tilt[1] - tilted.tilt[1]) == pytest.approx(3e-5, rel=0.1)
    for _ in range(5):
        update()
        assert np.array_equal(scanner.read_scanner(collection).tilt, read.tilt)


def test_a_tilted_module_that_is_only_moved_keeps_its_direction(collection, tilted):
    camera = scanner.module(collection, 2)
    move(camera, z=4.0)
    read = scanner.read_scanner(collection)
    assert np.allclose(read.frames()[1], tilted.frames()[1], rtol=0, atol=1e-12)
    collection.mphdrr_scanner.keep_aimed = True
    move(camera, z=1.0)
    assert not scanner.read_scanner(collection).tilt[1].any()
    assert np.array_equal(np.delete(scanner.read_scanner(collection).tilt, 1, 0), np.delete(tilted.tilt, 1, 0))


def test_copies_along_the_ring_keep_the_tilt(collection, tilted):
    for follow_ring in (False, True):
        third, angle = [scanner.module(collection, 3)], 0.21 + follow_ring / 10
        (copy,) = module_edits.duplicate_modules(collection, third, 1, angle, follow_ring)
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
        item = bpy.data.objects[f"{part.kind.capitalize()} {part.number:02d}"]
        points = np.array([item.matrix_world @ v.co for v in item.data.vertices])
        assert np.allclose(points, part.vertices, atol=1e-4)
