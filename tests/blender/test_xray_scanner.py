"""X-ray sources and panels in the scene, beside pinholes, and a kind of scanner that this file alone defines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

import mphdrr.core as mph
from mphdrr.addon import registration
from mphdrr.addon.blender import ids, storage
from mphdrr.addon.runs import preview, rendering, runs
from mphdrr.addon.scanner import cameras, scanner, sight_lines
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry import scanner as kinds
from mphdrr.core.geometry.columns import Column, ColumnTable
from mphdrr.core.geometry.scanner import Scanner
from mphdrr.core.xray.system import XraySystem

from .conftest import assert_same, refused, reopened, update


def added(name: str, attribute: str, **more: Any) -> Column:
    return Column(name, attribute, headings=(name, attribute), help=attribute, **more)


@pytest.fixture
def toy():
    """Yield a kind of scanner with columns of every kind and no checks, known while a test runs."""

    class Toy(XraySystem):
        kind: ClassVar[str] = "toy x-ray"
        sheet: ClassVar[str] = "C-arms"
        word: ClassVar[str] = "Arm"
        findings = Scanner.findings
        columns: ClassVar[ColumnTable] = ColumnTable(
            (
                *(replace(column, place="") for column in XraySystem.columns.values()),
                added("turn", "gantry_angle", kind="angle", unit="deg", blank=0.0),
                added("frames", "frames_per_turn", kind="whole", blank=1),
                added("tube", "anode", kind="choice", choices=("W", "Mo", "Rh"), blank="W"),
                added("serial", "serial_number", kind="text", blank=""),
            )
        )

    registration.unregister()
    registration.register()
    yield Toy
    registration.unregister()
    del kinds.SCANNERS[Toy.kind]
    registration.register()


@pytest.fixture(params=["x-ray", "toy"])
def system(request):
    """Return three sources with panels wider than high, of a kind that is shipped or of one that is not."""
    arc = mph.xray_arc(3, panel_size=(300, 200), shape=(20, 40), kvp=[80, 100, 120])
    if request.param == "x-ray":
        return arc
    more = {"gantry_angle": np.radians([12.3, 45.6, 0.0]), "frames_per_turn": [360, 720, 1], "anode": ["W", "Mo", "W"]}
    return request.getfixturevalue("toy").of(
        {**{name: getattr(arc, name) for name in arc.columns.fields}, **more, "serial_number": ["A-17 é", "", ""]}
        | {"shape": None, "numbers": [3, 8, 9]}
    )


@pytest.fixture
def path(system, small_workbook, tmp_path):
    return mph.write_system(system, tmp_path / "both.xlsx", small_workbook).path


@pytest.fixture
def collection(scene, system, path):
    """Import the X-ray scanner beside the pinholes and choose it."""
    assert bpy.ops.mphdrr.import_geometry(filepath=str(path)) == {"FINISHED"}
    update()
    scene.mphdrr_geometry.scanner = scanner.find_scanner(scene, f"both {system.kind}")
    return scene.mphdrr_geometry.scanner


def add_body(shape, spacing: float) -> mph.Volume:
    """Add random voxels of mu to the scene."""
    values = np.random.default_rng(1).uniform(0.0, 0.02, shape).astype(np.float32)
    volume = mph.Volume(values, mph.Grid.centered(shape, spacing), "mu")
    volumes.add_volume(volume, "Body")
    return volume


def test_only_the_active_sources_panel_is_shown(collection, scene):
    modules = scanner.modules(collection)
    panels = {o.parent: o for o in collection.all_objects if o.mphdrr_module.part == "PANEL"}

    def shown() -> list[bpy.types.Object]:
        update()
        return [camera for camera in modules if not panels[camera].hide_viewport]

    for camera in reversed(modules):
        bpy.context.view_layer.objects.active = camera
        assert shown() == [camera] and not panels[modules[0]].hide_render
    scanner.set_visible(modules[0], False)
    assert shown() == []
    scanner.set_visible(modules[0], True)
    assert shown() == modules[:1]
    scene.mphdrr_geometry.scanner = next(c for c in scanner.scanners(scene) if c != collection)
    bpy.context.view_layer.objects.active = None
    assert shown() == []


def test_both_scanners_of_a_workbook_are_imported_and_kept(scene, collection, system, tmp_path):
    assert len(scanner.read_scanner(scanner.find_scanner(scene, "both"))) == 16
    assert_same(scanner.read_scanner(collection), system)
    assert scanner.losses(collection) == [] and scanner.aim_modules(collection) == []
    assert {o.name for o in collection.all_objects} == {
        f"{word} {number:02d}" for word in (system.word, "Source", "Panel") for number in system.numbers
    }
    panel = bpy.data.objects[f"Panel {system.numbers[1]:02d}"]
    corners = np.array([panel.matrix_world @ v.co for v in panel.data.vertices])
    np.testing.assert_allclose(corners[4:].mean(axis=0), system.panel_centers[1], atol=1e-3)
    if system.kind == "x-ray":
        assert bpy.ops.mphdrr.check_geometry() == {"FINISHED"}
        assert "of its cone is blocked" in collection.mphdrr_scanner.findings
    else:
        refused(bpy.ops.mphdrr.check_geometry, "no checks of a scanner of the kind toy x-ray")
    opened = scanner.active_scanner(reopened(tmp_path / "a.blend"))
    assert_same(scanner.read_scanner(opened), system)
    opened.mphdrr_scanner.kind = "of another extension"
    with pytest.raises(mph.InputError, match="of another extension"):
        scanner.read_scanner(opened)


def test_its_cameras_see_what_its_panels_show(scene, collection, system):
    camera = scanner.modules(collection)[1]
    render, (n_v, n_u) = scene.render, system.pixels
    render.resolution_x, render.resolution_y = n_u, n_v
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, 4 / 3
    update()
    _, targets = system.views().rays(1)
    seen = np.array([world_to_camera_view(scene, camera, Vector(target))[:2] for target in targets])
    i, j = np.divmod(np.arange(n_v * n_u), n_u)
    # Seen from the source +u is to the left, and +v is up.
    np.testing.assert_allclose(seen, np.stack([1 - (j + 0.5) / n_u, (i + 0.5) / n_v], axis=1), atol=2e-6)
    scene.mphdrr_geometry.show_detectors = scene.mphdrr_geometry.sight_all = True
    drawn = sight_lines.lines(bpy.context)["show_detectors"].reshape(3, 4, 2, 3)
    np.testing.assert_allclose(drawn.mean(axis=(1, 2)), system.panel_centers, atol=1e-3)


def test_moves_turns_and_edits_are_read_back_and_written(collection, system, path, tmp_path):
    first, _, third = scanner.modules(collection)
    third.location.z += 4.0
    third.mphdrr_module.kvp, third.mphdrr_module.filters = 140.0, "Cu 0.2"
    first.rotation_euler.z += 0.1
    bpy.data.objects[f"Panel {system.numbers[1]:02d}"].location.x += 5.0  # a grabbed panel takes its source along
    update()
    read = scanner.read_scanner(collection)
    moves = read.sources - system.sources
    assert moves[2, 2] == pytest.approx(4) and np.linalg.norm(moves[1]) == pytest.approx(5, abs=1e-3)
    np.testing.assert_allclose(read.panel_centers[1:], (system.panel_centers + moves)[1:], atol=1e-3)
    assert read.kvp.tolist() == [80, 100, 140] and read.filters.tolist() == ["Al 2.5", "Al 2.5", "Cu 0.2"]
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    np.testing.assert_allclose(read.panel_u[0], turn @ system.panel_u[0], atol=1e-5)
    numbers = ", ".join(map(str, system.numbers))
    assert scanner.losses(collection) == [
        f"modules {numbers} moved or turned", f"module {system.numbers[2]} with changed numbers",
    ]  # fmt: skip
    third.mphdrr_module.filters = "aluminium"
    assert "expected materials with their mm" in third.mphdrr_module.problem
    third.mphdrr_module.filters = "Cu 0.2"
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "edited.xlsx"))
    assert_same(mph.read_scanner(tmp_path / "edited.xlsx", system.kind), read)
    np.testing.assert_array_equal(mph.read_system(tmp_path / "edited.xlsx").centers, mph.read_system(path).centers)


@pytest.mark.parametrize("system", ["toy"], indirect=True)
def test_columns_of_every_kind_are_edited_and_modules_renumbered_and_copied(collection, system):
    first, second, _ = scanner.modules(collection)
    first.mphdrr_module.anode, first.mphdrr_module.gantry_angle = "Rh", np.radians(30.0)
    first.mphdrr_module.serial_number, second.mphdrr_module.frames_per_turn = "B-2", 90
    read = scanner.read_scanner(collection)
    assert read.anode.tolist() == ["Rh", "Mo", "W"] and read.serial_number.tolist() == ["B-2", "", ""]
    assert read.gantry_angle.tolist() == [np.radians(30.0), *system.gantry_angle[1:]]
    assert read.frames_per_turn.tolist() == [360, 90, 1]
    assert scanner.losses(collection) == ["modules 3, 8 with changed numbers"]
    collection.mphdrr_scanner.anode = "Mo"
    assert scanner.read_scanner(collection).anode.tolist() == ["Mo"] * 3
    assert bpy.ops.mphdrr.renumber_modules() == {"FINISHED"}
    assert sorted(scanner.read_scanner(collection).numbers) == [1, 2, 3]
    bpy.ops.mphdrr.duplicate_modules(count=1, angle=0.4)
    assert len(scanner.read_scanner(collection)) == 4


def test_a_radiograph_is_rendered_and_current_until_a_source_moves(scene, collection, system):
    body = add_body((20, 24, 16), 6.0)
    panel = scene.mphdrr_projections
    panel.model, panel.width, panel.height = "TRANSMISSION", 40, 20
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    run = mph.read_run(storage.absolute(panel.run_file))
    expected = mph.Projector(body.grid, system.views(), model=mph.Transmission(), backend="numpy")(body)
    np.testing.assert_allclose(run.projections, expected, atol=1e-3 * expected.max())
    assert_same(run.system, system)
    assert runs.changes(scene) == []
    scanner.modules(collection)[1].location.z += 2.0
    update()
    assert runs.changes(scene) == [f"Module {system.numbers[1]:02d} moved"]


def test_an_arc_and_a_ring_are_added_beside_the_pinholes(scene, imported):
    assert bpy.ops.mphdrr.add_xray_system() == {"FINISHED"}
    arc = scanner.active_scanner(scene)
    assert arc.name == "X-ray" and scanner.find_scanner(scene, "small") is not None
    assert_same(scanner.read_scanner(arc), mph.xray_arc())
    bpy.ops.mphdrr.add_xray_system(arrangement="RING", sources=5, pixels=16, kvp=120.1)
    xray_ring = scanner.active_scanner(scene)
    assert xray_ring.name == "X-ray 2"
    assert_same(scanner.read_scanner(xray_ring), mph.xray_ring(5, shape=(16, 16), kvp=120.1))
    refused(bpy.ops.mphdrr.add_xray_system, "less than the sources' 150 mm", source_radius=150)
    assert len(scanner.scanners(scene)) == 3 and scanner.active_scanner(scene) == xray_ring


def test_looking_through_a_panel_that_is_not_square_stretches_nothing(scene, small_workbook):
    arc = scanner.build_scanner(scene, mph.xray_arc(2, panel_size=(300, 200)))
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    render = scene.render
    assert render.pixel_aspect_x == render.pixel_aspect_y == 1
    scene.mphdrr_geometry.scanner = arc
    bpy.ops.mphdrr.look_through_module(number=2)
    sides = render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y
    assert sides[0] / sides[1] == pytest.approx(1.5)
    assert cameras.field_of(scene.camera.data)[3:] == pytest.approx((300, 200))


def test_what_the_panel_shows_is_what_is_rendered(scene):
    bpy.ops.mphdrr.add_xray_system(sources=24, pixels=20)
    panel, render = scene.mphdrr_projections, bpy.ops.mphdrr.render_projections
    assert scanner.fixed_pixels(scanner.active_scanner(scene)) == (20, 20)
    assert (panel.model, scene.mphdrr_reconstruction.method) == ("TRANSMISSION", "SIRT")
    panel.width, panel.detector = 48, "REAL"  # for pinholes
    recipe = runs.panel_recipe(scene)
    assert [recipe[f"detector.{name}"] for name in ("rows", "columns", "plane")] == [20, 20, "virtual"]
    bpy.ops.mphdrr.add_points(attenuation=False, voxels=8)
    refused(render, "no volume of mu")  # X rays see no activity
    assert not rendering.integrates_activity(bpy.context)
    add_body((12, 12, 12), 12.0)
    assert preview.read_request(bpy.context).recipe["detector.rows"] == 20
    assert render() == {"FINISHED"}
    assert mph.read_run(storage.absolute(panel.run_file)).projections.shape == (24, 20, 20)
    assert all(f"mphDRR {n:02d}" in bpy.data.images for n in (1, 24)) and ids.MOSAIC in bpy.data.images
    assert runs.changes(scene) == []
    assert render(width=10, height=5) == {"FINISHED"}
    assert mph.read_run(storage.absolute(panel.run_file)).projections.shape == (24, 5, 10)
    refused(render, "expected a PinholeSystem", model="EMISSION")
    assert bpy.ops.mphdrr.reconstruct(iterations=3, voxels=16) == {"FINISHED"}
    assert volumes.quantity_of(scene.mphdrr_reconstruction.volume) == "mu"


def test_a_dose_map_is_that_of_the_active_activity(scene):
    grid = mph.Grid.centered((6, 5, 4), 4.0)
    activity = mph.Volume(np.random.default_rng(4).uniform(0, 100, grid.shape), grid)
    item = volumes.add_volume(activity, "Liver", np.diag([1.0, -1.0, -1.0, 1.0]))
    bpy.context.view_layer.objects.active = item
    assert bpy.ops.mphdrr.add_dose_map(isotope="Lu-177") == {"FINISHED"}
    dose_map = bpy.context.object
    assert dose_map.name == "Liver dose rate" and dose_map.mphdrr_volume.unit == "mGy/h"
    dose = volumes.volume_from_object(dose_map)
    expected = mph.absorbed_dose_rate(volumes.volume_from_object(item), "Lu-177")
    np.testing.assert_allclose(dose.array, expected.array, rtol=1e-5)
    np.testing.assert_allclose(dose.grid.affine, expected.grid.affine)
    assert not bpy.ops.mphdrr.add_dose_map.poll()  # of a dose there is none


def test_the_bore_is_checked_if_it_is_given(scene):
    bpy.ops.mphdrr.add_xray_system(sources=3)
    settings = scanner.active_scanner(scene).mphdrr_scanner
    for bore, is_said in ((None, False), (250.0, True)):
        if bore:
            settings.bore = bore
        bpy.ops.mphdrr.check_geometry()
        assert ("bore" in settings.findings) == is_said


def test_making_a_dose_map_can_be_cancelled():
    def cancel(done: int, total: int) -> None:
        if done == 3:
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        mph.absorbed_dose_rate(mph.Volume(np.ones((8, 8, 8)), mph.Grid.centered(8, 4.0)), "I-131", progress=cancel)
