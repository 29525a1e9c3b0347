"""Blender's cameras agree with `Views`: by Blender's own projection, and by Cycles."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from mphdrr.addon.scanner import scanner
from mphdrr.core.geometry.collimator import Construction
from mphdrr.core.geometry.system import PinholeSystem
from mphdrr.core.geometry.views import Views


def project(views: Views, points: np.ndarray) -> np.ndarray:
    """(M, N, 2) columns and rows of world points (N, 3)."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    image = np.einsum("mij,nj->mni", views.projection_matrices(), homogeneous)
    return image[..., :2] / image[..., 2:]


def blender_pixels(scene, camera, points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(N, 2) columns and rows by Blender; its x grows to the right, which is -u."""
    n_v, n_u = shape
    seen = np.array([world_to_camera_view(scene, camera, Vector(p))[:] for p in points])
    return np.stack([(1 - seen[:, 0]) * n_u - 0.5, seen[:, 1] * n_v - 0.5], axis=1)


def assert_blender_agrees(scene, collection, views: Views) -> None:
    bpy.context.view_layer.update()
    inside_roi = scanner.modules(collection)[0].mphdrr_module.roi_radius / np.sqrt(3)
    points = np.random.default_rng(1).uniform(-inside_roi, inside_roi, (40, 3))
    for camera, expected in zip(scanner.modules(collection), project(views, points), strict=True):
        got = blender_pixels(scene, camera, points, views.shape)
        assert np.abs(got - expected).max() < 1e-3


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
def test_markers_rendered_by_cycles_land_where_views_say(scene, dc_spect, number, tmp_path):
    """Not mirrored and not upside down: the markers differ in size and have no symmetry."""
    shape = (96, 128)
    collection = scanner.build_scanner(scene, dc_spect, shape=shape)
    for item in list(scene.objects):
        if item.type in {"LIGHT", "MESH"} and item.mphdrr_module.part == "NONE":
            bpy.data.objects.remove(item)
    markers = np.array([[28.0, 6.0, 35.0], [-17.0, 30.0, -22.0], [9.0, -31.0, 12.0]])
    for channel, center in enumerate(markers):  # red, green, blue
        scene.collection.objects.link(emitting_sphere(center, 2.5, channel))
    scene.camera = scanner.module(collection, number)
    pixels = render(scene, tmp_path / "markers.exr")
    as_arrays = pixels[:, ::-1]  # pictures have -u to the right; rows already grow along +v
    expected = project(dc_spect.views(shape=shape)[number - 1], markers)[0]
    for channel in range(3):
        weight = as_arrays[:, :, channel] * (as_arrays[:, :, channel] > 0.2)
        assert weight.sum() > 0
        rows, columns = np.indices(weight.shape)
        got = [(columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()]
        assert np.abs(np.array(got) - expected[channel]).max() < 1.0


def emitting_sphere(center: np.ndarray, radius: float, channel: int) -> bpy.types.Object:
    mesh = bpy.data.meshes.new("Marker")
    shape = bmesh.new()
    bmesh.ops.create_icosphere(shape, subdivisions=3, radius=radius)
    shape.to_mesh(mesh)
    shape.free()
    material = bpy.data.materials.new("Marker")
    if material.node_tree is None:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = [float(i == channel) for i in range(3)] + [1.0]
    material.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    mesh.materials.append(material)
    marker = bpy.data.objects.new("Marker", mesh)
    marker.location = center
    return marker


def render(scene: bpy.types.Scene, path) -> np.ndarray:
    """The scene by Cycles: (rows from the bottom, columns from the left, 3), linear."""
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", 4
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 2
    scene.world = None
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode = "OPEN_EXR", "RGB"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    columns, rows = image.size
    pixels = np.empty(columns * rows * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(rows, columns, 4)[..., :3]
