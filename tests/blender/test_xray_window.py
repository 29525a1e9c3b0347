"""The window's way from an empty scene to an X-ray image, a volume of mu and a dose map."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import ids, storage
from mphdrr.addon.runs import preview, rendering, runs
from mphdrr.addon.scanner import cameras, scanner
from mphdrr.addon.volumes import volumes


def assert_same(one, other) -> None:
    assert len(one) == len(other)
    for name, values in one.values().items():
        np.testing.assert_array_equal(values, other.values()[name], err_msg=name)


def test_an_arc_and_a_ring_are_added_beside_the_pinholes(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    assert bpy.ops.mphdrr.add_xray_system() == {"FINISHED"}
    arc = scanner.active_scanner(scene)
    assert arc.name == "X-ray" and scanner.find_scanner(scene, "small") is not None
    assert_same(scanner.read_scanner(arc), mph.xray_arc())
    bpy.ops.mphdrr.add_xray_system(arrangement="RING", sources=5, pixels=16, kvp=120.1)
    ring = scanner.active_scanner(scene)
    assert ring.name == "X-ray 2"
    assert_same(scanner.read_scanner(ring), mph.xray_ring(5, shape=(16, 16), kvp=120.1))
    with pytest.raises(RuntimeError, match="less than the sources' 150 mm"):
        bpy.ops.mphdrr.add_xray_system(source_radius=150)
    assert len(scanner.scanners(scene)) == 3 and scanner.active_scanner(scene) == ring


def test_looking_through_a_panel_that_is_not_square_stretches_nothing(scene, small_workbook):
    arc = scanner.build_scanner(scene, mph.xray_arc(2, panel_size=(300, 200)))
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    assert scene.render.pixel_aspect_x == scene.render.pixel_aspect_y == 1
    scene.mphdrr_geometry.scanner = arc
    bpy.ops.mphdrr.look_through_module(number=2)
    render = scene.render
    seen = render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y
    assert seen[0] / seen[1] == pytest.approx(1.5)
    assert cameras.field_of(scene.camera.data)[3:] == pytest.approx((300, 200))


def test_what_the_panel_shows_is_what_is_rendered(scene):
    bpy.ops.mphdrr.add_xray_system(sources=24, pixels=20)
    collection, panel = scanner.active_scanner(scene), scene.mphdrr_projections
    assert scanner.fixed_pixels(collection) == (20, 20)
    assert (panel.model, scene.mphdrr_reconstruction.method) == ("TRANSMISSION", "SIRT")
    panel.width, panel.detector = 48, "REAL"  # for pinholes
    recipe = runs.panel_recipe(scene)
    assert [recipe[f"detector.{name}"] for name in ("rows", "columns", "plane")] == [20, 20, "virtual"]
    bpy.ops.mphdrr.add_points(attenuation=False, voxels=8)
    with pytest.raises(RuntimeError, match="no volume of mu"):  # X rays see no activity
        bpy.ops.mphdrr.render_projections()
    assert not rendering.integrates_activity(bpy.context)
    grid = mph.Grid.centered(12, 12.0)
    values = np.random.default_rng(3).uniform(0.0, 0.02, grid.shape).astype(np.float32)
    volumes.add_volume(mph.Volume(values, grid, "mu"), "Body")
    assert preview.read_request(bpy.context).recipe["detector.rows"] == 20
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    run = mph.read_run(storage.absolute(panel.run_file))
    assert run.projections.shape == (24, 20, 20)
    assert all(f"mphDRR {n:02d}" in bpy.data.images for n in (1, 24)) and ids.MOSAIC in bpy.data.images
    assert runs.changes(scene) == []
    assert bpy.ops.mphdrr.render_projections(width=10, height=5) == {"FINISHED"}
    assert mph.read_run(storage.absolute(panel.run_file)).projections.shape == (24, 5, 10)
    with pytest.raises(RuntimeError, match="expected a PinholeSystem"):
        bpy.ops.mphdrr.render_projections(model="EMISSION")
    assert bpy.ops.mphdrr.reconstruct(iterations=3, voxels=16) == {"FINISHED"}
    assert volumes.quantity_of(scene.mphdrr_reconstruction.volume) == "mu"


def test_a_dose_map_is_that_of_the_active_activity(scene):
    grid = mph.Grid.centered((6, 5, 4), 4.0)
    activity = mph.Volume(np.random.default_rng(4).uniform(0, 100, grid.shape), grid)
    item = volumes.add_volume(activity, "Liver", np.diag([1.0, -1.0, -1.0, 1.0]))
    bpy.context.view_layer.objects.active = item
    assert bpy.ops.mphdrr.add_dose_map(isotope="Lu-177") == {"FINISHED"}
    made = bpy.context.object
    assert made.name == "Liver dose rate" and made.mphdrr_volume.unit == "mGy/h"
    found, expected = (
        volumes.volume_from_object(made),
        mph.absorbed_dose_rate(volumes.volume_from_object(item), "Lu-177"),
    )
    np.testing.assert_allclose(found.array, expected.array, rtol=1e-5)
    np.testing.assert_allclose(found.grid.affine, expected.grid.affine)
    assert not bpy.ops.mphdrr.add_dose_map.poll()  # of a dose there is none


def test_making_a_dose_map_can_be_cancelled():
    class Stop(Exception):
        pass

    def progress(done: int, total: int) -> None:
        if done == 3:
            raise Stop

    with pytest.raises(Stop):
        mph.absorbed_dose_rate(mph.Volume(np.ones((8, 8, 8)), mph.Grid.centered(8, 4.0)), "I-131", progress=progress)


def test_the_bore_is_checked_if_it_is_given(scene):
    bpy.ops.mphdrr.add_xray_system(sources=3)
    collection = scanner.active_scanner(scene)
    bpy.ops.mphdrr.check_geometry()
    assert "bore" not in collection.mphdrr_scanner.findings
    collection.mphdrr_scanner.bore = 250.0
    bpy.ops.mphdrr.check_geometry()
    assert "bore" in collection.mphdrr_scanner.findings
