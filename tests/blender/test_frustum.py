"""Volumes in a module's coordinates: where layers stand and what they show, how they follow and go; back on voxels."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import ids, objects, storage
from mphdrr.addon.perspective import frustums
from mphdrr.addon.scanner import module_edits, scanner
from mphdrr.addon.volumes import slices, volumes
from mphdrr.core.runs.mosaic import as_seen

from .conftest import cancelled, datablocks, move, refused, reopened, turn, update

SHAPE = 18, 26  # rows, columns


@pytest.fixture
def shown(scene, derenzo):
    """Return a turned phantom in a scanner of eight modules, whose pixels are not the square ones of a square image."""
    scene.mphdrr_projections.height, scene.mphdrr_projections.width = SHAPE
    choose(3)
    return derenzo


def choose(number: int) -> bpy.types.Object:
    """Make a module active in the list; the active object stays."""
    scene = bpy.context.scene
    collection = scanner.active_scanner(scene)
    camera = scanner.module(collection, number)
    active = bpy.context.view_layer.objects.active
    scene.mphdrr_geometry.active_index = collection.all_objects.find(camera.name)
    bpy.context.view_layer.objects.active = active
    update()
    return camera


def grid_of(item, system, m: int, n_k: int, uniform: str) -> mph.PerspectiveGrid:
    """Return the cells of a module's frustum: between the depths of the first and last voxels' corners."""
    views, volume = system[m : m + 1].views(SHAPE), volumes.volume_from_object(item)
    filled = np.argwhere(volume.array != 0)[:, None] + np.reshape(np.indices((2, 2, 2)), (3, -1)).T - 0.5
    places = filled @ volume.grid.affine[:3, :3].T + volume.grid.affine[:3, 3]
    depths = (places - views.sources[0]) @ system.frames()[m, 2]
    return mph.PerspectiveGrid(views, 0, n_k, depths.min(), depths.max(), uniform)


def corners(layer: bpy.types.Object) -> np.ndarray:
    """Return the corners (2, 2, 3) of an image empty in the world, [top, right]."""
    width, height = layer.data.size
    half = layer.empty_display_size / max(width, height) / 2  # a picture's longer side is as long as the empty
    matrix = np.array(layer.matrix_world, np.float64)
    return np.array([
        [(matrix @ [a * half * width, b * half * height, 0, 1])[:3] for a in (-1, 1)] for b in (-1, 1)
    ])  # fmt: skip


def expected_corners(g: mph.PerspectiveGrid, plane: int) -> np.ndarray:
    """Return the outermost pixels' outer corners as the pinhole sees them: +u to the left."""
    n_u, n_v, _ = g.shape
    return g.to_world([
        [[column - 0.5, row - 0.5, g.planes[plane]] for column in (n_u, 0)] for row in (0, n_v)
    ])  # fmt: skip


def names() -> dict[str, list[str]]:
    return datablocks("objects", "meshes", "images", "collections", "volumes", "materials")


def show(planes: int, **settings: str) -> bpy.types.Object:
    """Show the active volume in the chosen module's perspective, and return the only frustum."""
    assert bpy.ops.mphdrr.show_in_perspective(planes=planes, **settings) == {"FINISHED"}
    (frustum,) = frustums.frustums(bpy.context.scene)
    update()
    return frustum


@pytest.mark.parametrize(("uniform", "detector"), [("K", "VIRTUAL"), ("DEPTH", "REAL")])
def test_layers_stand_on_the_rays_of_their_pixels_and_show_their_means(shown, scene, ring_system, uniform, detector):
    scene.mphdrr_projections.detector = detector
    frustum = show(5, uniform=uniform)
    assert frustum.name == "Perspective 03" and frustum.parent.name == "Module 03" and bpy.context.object == shown
    g = grid_of(shown, ring_system, 2, 5, uniform.lower())  # the real detector's pixels are on the same rays, but
    turned = slice(None, None, -1 if detector == "REAL" else 1)  # the other way round
    means = mph.to_perspective(volumes.volume_from_object(shown), g)
    low, high = shown.mphdrr_volume.display_low, shown.mphdrr_volume.display_high
    layers = frustums.layers(frustum)
    assert len(layers) == 5 and means.max() > 0.3 * high
    source = ring_system.centers[2]
    for plane, layer in enumerate(layers):
        np.testing.assert_allclose(corners(layer)[turned, turned], expected_corners(g, plane), atol=1e-4)
        picture = layer.data
        assert picture.size[:] == SHAPE[::-1] and picture.packed_file is not None
        pixels = np.rint(255 * np.reshape(picture.pixels[:], (*SHAPE, 4)))[::-1][turned, turned]
        np.testing.assert_array_equal(
            pixels, frustums.color_values(as_seen(means[..., plane].T), "activity", low, high)
        )
    # Seen from the pinhole, layers lie on one another: corners are on rays, and magnification makes them as large.
    rays = np.array([corners(layer).reshape(-1, 3) - source for layer in layers])
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    np.testing.assert_allclose(rays, np.broadcast_to(rays[:1], rays.shape), atol=1e-6)
    points = np.array([vertex.co for vertex in frustum.data.vertices])
    world = points @ np.array(frustum.matrix_world)[:3, :3].T + np.array(frustum.matrix_world)[:3, 3]
    np.testing.assert_allclose(world[0], source, atol=1e-4)
    lines = {tuple(sorted(map(tuple, world[list(edge.vertices)].round(2)))) for edge in frustum.data.edges}
    assert len(lines) == 5 * 4 + 4


def test_what_is_low_is_transparent_and_colours_are_those_of_slices():
    values = np.array([-1.0, 0.0, 0.5, 1.0, 3.0], np.float32)
    found = frustums.color_values(values, "activity", 0.0, 1.0)
    assert found[:, 3].tolist() == [0, 0, 180, 255, 255]
    np.testing.assert_array_equal(found[3, :3], np.rint(255 * slices.color_table("activity")[-1, :3]))


def test_ct_numbers_are_air_outside_their_grid(ring_system):
    grid = mph.Grid.centered((9, 8, 7), 6.0)
    values = np.random.default_rng(3).uniform(-1000, 800, grid.shape).astype(np.float32)
    views = ring_system[4:5].views((12, 10))
    (near,), (far,) = mph.depth_ranges(views, grid)
    g = mph.PerspectiveGrid(views, 0, 8, near, far)
    found = frustums.to_module_cells(mph.Volume(values, grid, "hu"), g)
    np.testing.assert_allclose(found, mph.to_perspective(values + 1000, g, grid=grid) - 1000, atol=1e-3)
    back = frustums.to_voxels(found, g, mph.Volume(values, grid, "hu"))
    assert back.quantity == "hu" and back.array.min() >= -1000.01
    air = frustums.to_module_cells(mph.Volume(np.full(grid.shape, -1000, np.float32), grid, "hu"), g)
    assert np.all(air == -1000) and np.all(frustums.to_voxels(air, g, mph.Volume(values, grid, "hu")).array == -1000)


def test_it_goes_with_its_module_and_says_what_is_not_true_any_more(shown, scene):
    frustum = show(3)
    assert frustums.changes(scene, frustum) == ""
    camera = frustum.parent

    def places() -> list[np.ndarray]:
        return [np.array(camera.matrix_world.inverted() @ layer.matrix_world) for layer in frustums.layers(frustum)]

    before = places()
    move(camera, z=20.0)
    np.testing.assert_allclose(places(), before, atol=1e-3)
    assert frustums.changes(scene, frustum) == "Module 03 has moved, or has other pixels"
    move(camera, z=-20.0)
    assert frustums.changes(scene, frustum) == ""
    scene.mphdrr_projections.width = 30
    assert "other pixels" in frustums.changes(scene, frustum)
    scene.mphdrr_projections.width = SHAPE[1]
    assert frustums.visible_volumes(scene) == [shown]  # whose colour bar is drawn
    shown.mphdrr_volume.display_high *= 0.5
    assert frustums.visible_volumes(scene) == []
    assert frustums.changes(scene, frustum) == "other colours of Derenzo"
    move(shown, x=4.0)
    assert frustums.changes(scene, frustum) == "other place and colours of Derenzo"
    frustum = show(3)
    assert frustums.changes(scene, frustum) == ""
    bpy.data.objects.remove(shown)
    assert frustums.changes(scene, frustum) == "Derenzo is gone"


def test_a_module_that_is_turned_away_has_its_frustum_where_its_views_are(shown, scene, ring_system):
    camera = choose(3)
    turn(camera, y=0.05, z=-0.04)
    frustum = show(2)
    assert frustum.parent == camera
    tilted = scanner.read_scanner(scanner.active_scanner(scene))
    assert np.linalg.norm(tilted.tilt[2]) > 0.03
    g = grid_of(shown, tilted, 2, 2, "k")
    np.testing.assert_allclose(corners(frustums.layers(frustum)[1]), expected_corners(g, 1), atol=2e-4)


def test_again_replaces_and_clear_leaves_nothing(shown, scene):
    before = names()
    layers = frustums.layers(show(12))
    assert [layer.name for layer in layers][:2] == ["Perspective 03 layer 01", "Perspective 03 layer 02"]
    bpy.ops.mphdrr.show_in_perspective(planes=4)
    choose(5)
    bpy.ops.mphdrr.show_in_perspective(planes=2)
    assert [len(frustum.children) for frustum in frustums.frustums(scene)] == [4, 2]
    assert len(bpy.data.collections[ids.PERSPECTIVES].objects) == 8
    assert bpy.ops.mphdrr.clear_perspective() == {"FINISHED"}
    assert names() == before
    assert not bpy.ops.mphdrr.clear_perspective.poll()


def test_it_is_hidden_and_removed_with_its_module(shown, scene):
    before = names()
    frustum = show(2)
    scanner.set_visible(frustum.parent, False)
    update()
    assert frustum.hide_viewport and all(layer.hide_viewport for layer in frustum.children)
    scanner.set_visible(frustum.parent, True)
    update()
    assert not frustum.hide_viewport and not any(layer.hide_viewport for layer in frustum.children)
    camera = frustum.parent
    module_edits.remove_modules(scanner.active_scanner(scene), [camera])
    assert frustums.frustums(scene) == [] and names()["images"] == before["images"]
    choose(4)
    bpy.ops.mphdrr.show_in_perspective(planes=2)
    module_edits.remove_scanner(scene, scanner.active_scanner(scene))
    assert frustums.frustums(scene) == [] and names()["images"] == before["images"]
    assert names()["collections"] == [name for name in before["collections"] if "Ring" not in name]


def test_it_is_hidden_where_its_modules_camera_was_deleted(shown, scene):
    frustum = show(2)
    bpy.data.objects.remove(frustum.parent)
    update()
    assert frustums.changes(scene, frustum) == "its module is gone"
    frustums.after_update(scene, type("Updated", (), {"id_type_updated": lambda self, kind: True})())
    assert frustum.hide_viewport and all(layer.hide_viewport for layer in frustum.children)
    bpy.ops.mphdrr.clear_perspective()
    assert frustums.frustums(scene) == []


def test_what_cannot_be_shown_is_refused_in_a_line(shown, scene):
    shown.location = 2 * choose(3).location
    update()
    refused(bpy.ops.mphdrr.show_in_perspective, "'Derenzo' is not in front of the pinhole of Module 03")
    bpy.context.view_layer.objects.active = None
    assert not bpy.ops.mphdrr.show_in_perspective.poll() and not bpy.ops.mphdrr.resample_in_perspective.poll()


def test_a_volume_around_the_pinhole_begins_a_little_before_it(shown, scene):
    shown.scale = (6.0, 6.0, 6.0)
    update()
    frustum = show(4, uniform="DEPTH")
    source = np.array(frustum.parent.matrix_world)[:3, 3]
    depths = [-np.array(layer.matrix_basis)[2, 3] for layer in frustums.layers(frustum)]
    assert depths[0] > 0.1 * np.linalg.norm(source) and np.all(np.diff(depths) > 0)


def test_cancelled_it_leaves_everything_as_it_was(shown, scene):
    bpy.ops.mphdrr.show_in_perspective(planes=3)
    before, files = names(), sorted(storage.folder().iterdir())
    for job in (frustums.frustum_job(bpy.context, 4, "K"), frustums.resample_job(bpy.context, 8, "K")):
        cancelled(job, lambda done, total: total > 1)
    assert names() == before and sorted(storage.folder().iterdir()) == files


def test_undo_takes_it_back_and_redo_shows_it_again(shown, scene):
    bpy.ops.ed.undo_push(message="Before")
    pixels = list(frustums.layers(show(2))[0].data.pixels)
    bpy.ops.ed.undo_push(message="Perspective")
    bpy.ops.ed.undo()
    assert frustums.frustums(bpy.context.scene) == [] and ids.PERSPECTIVES not in bpy.data.collections
    bpy.ops.ed.redo()
    (frustum,) = frustums.frustums(bpy.context.scene)
    assert list(frustums.layers(frustum)[0].data.pixels) == pixels and max(pixels) > 0
    assert frustum.parent.name == "Module 03"


def test_a_saved_file_opens_with_it(shown, scene, tmp_path):
    pixels = list(frustums.layers(show(2))[1].data.pixels)
    reopened(tmp_path / "a.blend")
    (frustum,) = frustums.frustums(bpy.context.scene)
    assert list(frustums.layers(frustum)[1].data.pixels) == pixels and max(pixels) > 0
    assert frustums.changes(bpy.context.scene, frustum) == ""


def test_back_on_voxels_it_is_what_the_modules_cells_keep(shown, scene, ring_system):
    scene.mphdrr_perspective.cells = 9
    shown.mphdrr_volume.display_high = 0.7
    assert bpy.ops.mphdrr.resample_in_perspective() == {"FINISHED"}
    item = bpy.context.object
    assert item.name == "Derenzo through Module 03" and item.mphdrr_volume.display_high == pytest.approx(0.7)
    volume, found = volumes.volume_from_object(shown), volumes.volume_from_object(item)
    g = grid_of(shown, ring_system, 2, 9, "k")
    expected = mph.from_perspective(mph.to_perspective(volume, g), g, volume.grid)
    assert found.quantity == "activity"
    np.testing.assert_allclose(found.grid.affine, volume.grid.affine, atol=1e-5)
    np.testing.assert_allclose(found.array, expected, atol=1e-5 * expected.max())
    np.testing.assert_allclose(objects.world_matrix(item), objects.world_matrix(shown), atol=1e-6)
    assert frustums.volume_name(show(2)) == item.name
