"""X-ray sources and panels in the scene, beside the pinholes of the same workbook."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

import mphdrr.core as mph
from mphdrr.addon.blender import storage
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner, sight_lines
from mphdrr.addon.volumes import volumes


@pytest.fixture
def system():
    """Three sources with panels that are wider than high."""
    return mph.xray_arc(3, panel_size=(300, 200), shape=(20, 40), kvp=[80, 100, 120])


@pytest.fixture
def path(system, small_workbook, tmp_path):
    return mph.write_system(system, tmp_path / "both.xlsx", small_workbook).path


@pytest.fixture
def collection(scene, path):
    """The X-ray scanner, imported beside the pinholes and chosen."""
    assert bpy.ops.mphdrr.import_geometry(filepath=str(path)) == {"FINISHED"}
    bpy.context.view_layer.update()
    found = scanner.find_scanner(scene, "both x-ray")
    scene.mphdrr_geometry.scanner = found
    return found


def assert_same(one, other) -> None:
    assert type(one) is type(other)
    for name, values in one.values().items():
        np.testing.assert_array_equal(values, other.values()[name], err_msg=name)


def test_both_scanners_of_a_workbook_are_imported(scene, collection, system, path):
    pinholes = scanner.find_scanner(scene, "both")
    assert len(scanner.read_scanner(pinholes)) == 16
    assert_same(scanner.read_scanner(collection), system)
    assert scanner.losses(collection) == []
    assert {o.name for o in collection.all_objects} == {
        f"{w} {n:02d}" for w in ("X-ray", "Source", "Panel") for n in (1, 2, 3)
    }
    panel = bpy.data.objects["Panel 02"]
    corners = np.array([panel.matrix_world @ v.co for v in panel.data.vertices])
    np.testing.assert_allclose(corners[4:].mean(axis=0), system.panel_centers[1], atol=1e-3)
    assert bpy.ops.mphdrr.check_geometry() == {"FINISHED"}
    assert "of its cone is blocked" in collection.mphdrr_scanner.findings


def test_its_cameras_see_what_its_panels_show(scene, collection, system):
    camera = scanner.module(collection, 2)
    render, (n_v, n_u) = scene.render, system.pixels
    render.resolution_x, render.resolution_y = n_u, n_v
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, 4 / 3
    bpy.context.view_layer.update()
    _, targets = system.views().rays(1)
    seen = np.array([world_to_camera_view(scene, camera, Vector(target))[:2] for target in targets])
    i, j = np.divmod(np.arange(n_v * n_u), n_u)
    np.testing.assert_allclose(seen, np.stack([1 - (j + 0.5) / n_u, (i + 0.5) / n_v], axis=1), atol=2e-6)
    scene.mphdrr_geometry.show_detectors = scene.mphdrr_geometry.sight_all = True
    drawn = sight_lines.lines(bpy.context)["show_detectors"].reshape(3, 4, 2, 3)
    np.testing.assert_allclose(drawn.mean(axis=(1, 2)), system.panel_centers, atol=1e-3)


def test_a_moved_source_and_an_edited_voltage_are_read_back_and_written(collection, system, path, tmp_path):
    camera = scanner.module(collection, 3)
    camera.location.z += 4.0
    camera.mphdrr_module.kvp, camera.mphdrr_module.filters = 140.0, "Cu 0.2"
    scanner.module(collection, 1).rotation_euler.z += 0.1
    bpy.context.view_layer.update()
    read = scanner.read_scanner(collection)
    expected = system.panel_centers[2] + (read.sources - system.sources)[2]
    np.testing.assert_allclose(read.panel_centers[2], expected)
    assert read.sources[2, 2] == pytest.approx(204) and read.kvp.tolist() == [80, 100, 140]
    assert read.filters.tolist() == ["Al 2.5", "Al 2.5", "Cu 0.2"]
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    np.testing.assert_allclose(read.panel_u[0], turn @ system.panel_u[0], atol=1e-5)
    assert scanner.losses(collection) == ["modules 1, 3 moved or turned", "module 3 with changed numbers"]
    camera.mphdrr_module.filters = "aluminium"
    assert "expected materials with their mm" in camera.mphdrr_module.problem
    camera.mphdrr_module.filters = "Cu 0.2"
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "edited.xlsx"))
    assert_same(mph.read_scanner(tmp_path / "edited.xlsx", "x-ray"), read)
    np.testing.assert_array_equal(mph.read_system(tmp_path / "edited.xlsx").centers, mph.read_system(path).centers)


def test_a_grabbed_panel_takes_its_source_along(collection, system):
    panel = bpy.data.objects["Panel 01"]
    panel.location.x += 5.0
    bpy.context.view_layer.update()
    read = scanner.read_scanner(collection)
    assert np.linalg.norm(read.sources[0] - system.sources[0]) == pytest.approx(5, abs=1e-3)
    np.testing.assert_allclose(
        read.panel_centers[0] - read.sources[0], (system.panel_centers - system.sources)[0], atol=1e-3
    )


def test_a_radiograph_is_rendered(scene, collection, system):
    grid = mph.Grid.centered((20, 24, 16), 6.0)
    array = np.random.default_rng(1).uniform(0.0, 0.02, grid.shape).astype(np.float32)
    volumes.add_volume(mph.Volume(array, grid, "mu"), "Box")
    panel = scene.mphdrr_projections
    panel.model, panel.width, panel.height = "TRANSMISSION", 40, 20
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    run = mph.read_run(storage.absolute(panel.run_file))
    expected = mph.Projector(grid, system.views(), model=mph.Transmission(), backend="numpy")(array)
    np.testing.assert_allclose(run.projections, expected, atol=1e-3 * expected.max())
    assert_same(run.system, system)
    assert runs.changes(scene) == []
    scanner.module(collection, 2).location.z += 2.0
    bpy.context.view_layer.update()
    assert runs.changes(scene) == ["Module 02 moved"]
