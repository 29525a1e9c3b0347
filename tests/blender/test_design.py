"""Live design: modules that are moved or changed follow with their shapes and readouts; copies; undo."""

from __future__ import annotations

import json
import warnings

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import objects
from mphdrr.addon.scanner import collimators, following, live_scanner, module_edits, scanner
from mphdrr.core.errors import InputError, InputWarning
from mphdrr.core.geometry.system import PinholeSystem

from .conftest import datablocks, move, part, refused, reopened, select, update


@pytest.fixture
def roi_system(ring_system) -> PinholeSystem:
    """Return `ring_system` with the lengths of the design formula."""
    return ring_system.replace(collimator_length=formula_lengths(ring_system))


@pytest.fixture
def collection(scene, roi_system):
    made = scanner.build_scanner(scene, roi_system)
    update()
    return made


def formula_lengths(system: PinholeSystem) -> np.ndarray:
    """Return the collimator lengths (M,) of the design formula, mm."""
    return mph.collimator_length(
        system.pinhole_distance, system.pinhole_diameter, system.detector_side, system.roi_radius
    )


def depth(camera: bpy.types.Object) -> tuple[float, float]:
    z = [v.co.z for v in part(camera, "CRYSTAL").data.vertices]
    return min(z), max(z)


def assert_consistent(collection: bpy.types.Collection) -> None:
    """Check that everything shown agrees with `read_scanner`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        system = scanner.read_scanner(collection)
    origin, intrinsic = np.zeros((1, 3)), collection.mphdrr_scanner.intrinsic_fwhm
    counts = 1e6 * mph.sensitivity(system, origin)[0]
    fwhm = mph.resolution(system, origin, intrinsic_fwhm=intrinsic)[0]
    for m, camera in enumerate(scanner.modules(collection)):
        module, l = camera.mphdrr_module, system.collimator_length[m]
        assert module.pinhole_distance == pytest.approx(system.pinhole_distance[m], rel=1e-6)
        assert module.sensitivity == pytest.approx(counts[m], rel=1e-6)
        assert module.resolution == pytest.approx(fwhm[m], rel=1e-6)
        assert module.magnification == pytest.approx(l / system.pinhole_distance[m], rel=1e-6)
        assert module.collimator_length == pytest.approx(l, rel=1e-6)
        assert camera.data.lens / camera.data.sensor_width == pytest.approx(l / system.detector_side[m], rel=1e-6)
        assert depth(camera) == pytest.approx((l, l + system.detector_thickness[m]), rel=1e-6)
        assert max(v.co.z for v in part(camera, "COLLIMATOR").data.vertices) == pytest.approx(l, rel=1e-6)
    properties = collection.mphdrr_scanner
    assert properties.count == len(system)
    assert properties.sensitivity == pytest.approx(counts.sum(), rel=1e-6)
    assert properties.resolution == pytest.approx(fwhm.mean(), rel=1e-6)


def test_scanner_shows_what_it_does_as_soon_as_it_is_built(scene, collection, roi_system):
    assert_consistent(collection)
    properties = collection.mphdrr_scanner
    assert properties.n_covering == 8 and properties.mixed == "collimator_length"
    assert (properties.roi_radius, properties.length_mode) == (60.0, "FROM_ROI")
    for camera in scanner.modules(collection):
        assert camera.mphdrr_module.length_mode == "FROM_ROI"
        assert camera.mphdrr_module.roi_seen == pytest.approx(60.0, rel=1e-6)
    assert np.array_equal(scanner.read_scanner(collection).collimator_length, roi_system.collimator_length)


def test_moved_module_stays_aimed_and_its_length_follows(collection, roi_system):
    camera = scanner.module(collection, 3)
    move(camera, z=7.25)
    assert_consistent(collection)
    system = scanner.read_scanner(collection)
    assert scanner.unaimed_numbers(collection, [camera]) == [] and camera.mphdrr_module.aimed
    assert system.centers[2, :2].tolist() == roi_system.centers[2, :2].tolist(), "x and y were not touched"
    assert system.centers[2, 2] == pytest.approx(roi_system.centers[2, 2] + 7.25, abs=1e-5)
    assert np.allclose(system.collimator_length, formula_lengths(system), rtol=1e-12, atol=0)
    others = np.arange(8) != 2
    assert np.array_equal(system.collimator_length[others], roi_system.collimator_length[others])
    camera.location = roi_system.centers[2]
    update()
    assert np.array_equal(scanner.read_scanner(collection).centers, roi_system.centers), "back in its place, exactly"
    assert np.array_equal(scanner.read_scanner(collection).collimator_length, roi_system.collimator_length)


def test_typed_numbers_are_the_decimals_that_were_typed(collection):
    camera = scanner.module(collection, 1)
    camera.mphdrr_module.pinhole_diameter = 2.7
    camera.mphdrr_module.detector_thickness = 6.35
    camera.location.x = 187.3
    update()
    read = scanner.read_module(collection, camera)
    assert (read.pinhole_diameter[0], read.detector_thickness[0], read.centers[0, 0]) == (2.7, 6.35, 187.3)
    assert_consistent(collection)


def test_typed_length_stays_until_it_comes_from_the_roi_again(collection):
    camera = scanner.module(collection, 2)
    module = camera.mphdrr_module
    module.collimator_length = 61.7
    assert module.length_mode == "TYPED"
    camera.location.x *= 1.1
    update()
    assert scanner.read_module(collection, camera).collimator_length == 61.7
    assert module.roi_seen != pytest.approx(60.0, rel=1e-3)
    assert_consistent(collection)
    module.length_mode = "FROM_ROI"
    assert module.roi_seen == pytest.approx(60.0, rel=1e-6)
    assert_consistent(collection)


def test_numbers_for_all_modules_at_once(collection):
    properties, names = collection.mphdrr_scanner, datablocks()
    scanner.module(collection, 5).mphdrr_module.pinhole_diameter = 3.1
    assert properties.mixed.split() == ["pinhole_diameter", "collimator_length"]
    before = properties.sensitivity
    properties.pinhole_diameter = 4.6
    system = scanner.read_scanner(collection)
    assert system.pinhole_diameter.tolist() == [4.6] * 8
    assert properties.mixed == "collimator_length"
    assert 3.5 * before < properties.sensitivity < 4.0 * before
    properties.roi_radius = 50.0
    roi = next(o for o in collection.objects if o.mphdrr_module.part == "ROI")
    assert max(v.co.length for v in roi.data.vertices) == pytest.approx(50.0, rel=1e-6)
    properties.collimator_length = 55.5
    assert properties.length_mode == "TYPED" and properties.mixed == ""
    assert scanner.read_scanner(collection).collimator_length.tolist() == [55.5] * 8
    properties.wall_thickness, properties.intrinsic_fwhm = 3.25, 1.75
    collimator = part(scanner.module(collection, 8), "COLLIMATOR")
    assert max(v.co.x for v in collimator.data.vertices) == pytest.approx(24.0 + 3.25)
    properties.detector_side = 40.0
    assert datablocks() == names
    assert_consistent(collection)


def test_turning_is_left_to_the_user_and_moving_aims_again(collection):
    camera = scanner.module(collection, 4)
    camera.rotation_euler.y += 0.2
    turned = camera.rotation_euler.copy()
    update()
    assert camera.rotation_euler == turned and not camera.mphdrr_module.aimed
    assert scanner.unaimed_numbers(collection, scanner.modules(collection)) == [4]
    move(camera, z=1.0)
    assert camera.mphdrr_module.aimed and scanner.unaimed_numbers(collection, [camera]) == []
    collection.mphdrr_scanner.keep_aimed = False
    rotation = camera.rotation_euler.copy()
    move(camera, z=1.0)
    assert camera.rotation_euler == rotation and not camera.mphdrr_module.aimed
    assert_consistent(collection)
    bpy.ops.mphdrr.aim_modules()
    assert camera.mphdrr_module.aimed and scanner.unaimed_numbers(collection, [camera]) == []


def test_hidden_parented_and_animated_modules(scene, collection):
    hidden = scanner.module(collection, 1)
    hidden.mphdrr_module.visible = False
    update()
    move(hidden, z=-9.0)
    assert hidden.mphdrr_module.aimed
    hidden.mphdrr_module.visible = True
    update()
    assert_consistent(collection)

    bench = bpy.data.objects.new("Bench", None)
    scene.collection.objects.link(bench)
    for camera in scanner.modules(collection):
        camera.parent = bench
    update()
    bench.location = (3.0, -2.0, 11.0)
    bench.rotation_euler.z = 0.4
    update()
    assert scanner.unaimed_numbers(collection, scanner.modules(collection)) == []
    assert_consistent(collection)

    alone, carried = (scanner.module(collection, number) for number in (6, 7))
    alone.parent = None
    for animated, camera in ((alone, alone), (bench, carried)):
        animated.keyframe_insert("location", frame=1)
        animated.location.x += 30.0
        animated.keyframe_insert("location", frame=20)
        scene.frame_set(1)
        update()
        rotation = camera.rotation_euler.copy()
        scene.frame_set(10)
        update()
        assert camera.rotation_euler == rotation and not camera.mphdrr_module.aimed
        assert_consistent(collection)


def test_what_the_handler_writes_does_not_call_it_for_ever(collection):
    seen = []
    bpy.app.handlers.depsgraph_update_post.append(lambda scene, depsgraph: seen.append(len(depsgraph.updates)))
    move(scanner.module(collection, 1), x=1.0)
    n = len(seen)
    update()
    update()
    bpy.app.handlers.depsgraph_update_post.pop()
    assert len(seen) <= n + 1


def test_selecting_a_module_or_moving_something_else_rebuilds_none_and_hiding_one_is_seen(
    scene, collection, monkeypatch
):
    calls = []
    monkeypatch.setattr(following, "refresh", lambda *args, **kwargs: calls.append(args))
    scene.objects["Cube"].location.x += 1.0
    update()
    for number in (2, 5, 7):
        select(scanner.module(collection, number))
        update()
        update()
    assert calls == []
    scanner.module(collection, 1).mphdrr_module.visible = False
    update()
    assert calls


def test_impossible_numbers_are_said_and_cured(collection):
    camera = scanner.module(collection, 7)
    module = camera.mphdrr_module
    before = depth(camera)
    module.pinhole_diameter = 500.0  # impossible: refused when read, but nothing breaks
    assert "module 7" in module.problem and module.sensitivity == 0.0 and depth(camera) == before
    with pytest.raises(InputError, match="module 7"):
        scanner.read_scanner(collection)
    module.pinhole_diameter = 2.5
    assert module.problem == ""
    camera.location = (20.0, 0.0, 10.0)
    update()
    assert "inside the ROI" in module.problem
    with pytest.raises(InputError, match="module 7"):
        scanner.read_scanner(collection)
    camera.location = (0.0, 0.0, 0.0)
    update()
    assert module.problem
    camera.location = (200.0, 0.0, 10.0)
    collection.mphdrr_scanner.plate_thickness = 400.0
    update()
    assert "aperture plate" in module.problem
    collection.mphdrr_scanner.plate_thickness = 2.0
    assert module.problem == ""
    assert_consistent(collection)


def test_after_an_undo_everything_agrees_again(collection):
    """Undo restores the camera, and may keep meshes and totals that have followed it since."""
    camera = scanner.module(collection, 2)
    module = camera.mphdrr_module
    names = [n for n in (p.identifier for p in module.bl_rna.properties) if n not in {"rna_type", "name", "visible"}]
    kept = {n: getattr(module, n)[:] if n == "placed" else getattr(module, n) for n in names}
    matrix = camera.matrix_basis.copy()
    camera.location.x *= 1.2
    module.detector_side = 40.0
    update()
    with following.writing():
        camera.matrix_basis = matrix
        for name, value in kept.items():
            setattr(module, name, value)
    assert depth(camera)[0] != pytest.approx(module.collimator_length, rel=1e-6)
    live_scanner.after_undo()
    assert_consistent(collection)


def test_blenders_own_duplicate_and_delete_are_tidied(collection):
    update()
    select(scanner.module(collection, 3))
    bpy.ops.object.duplicate()
    copy = bpy.context.view_layer.objects.active
    move(copy, z=40.0)
    assert collection.mphdrr_scanner.untidy == "1 copied camera"
    with pytest.raises(InputError, match="Tidy Modules"):
        scanner.read_scanner(collection)
    bpy.ops.mphdrr.tidy_modules()
    assert collection.mphdrr_scanner.untidy == ""
    system = scanner.read_scanner(collection)
    assert system.numbers.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert copy.name == "Module 09" and sorted(c.name for c in copy.children) == ["Collimator 09", "Crystal 09"]
    assert copy.data.users == 1
    assert_consistent(collection)
    assert scanner.losses(collection) == ["module 9 added"]

    select(scanner.module(collection, 5), *scanner.module(collection, 5).children)
    bpy.ops.object.duplicate()
    for item in bpy.context.selected_objects:
        if item.parent is None:
            item.location.z -= 35.0
    update()
    bpy.ops.mphdrr.tidy_modules()
    assert_consistent(collection)
    assert [len(c.children) for c in scanner.modules(collection)] == [2] * 10

    n_meshes = len(bpy.data.meshes)
    select(scanner.module(collection, 1))
    bpy.ops.object.delete()
    update()
    assert collection.mphdrr_scanner.untidy == "2 parts without a camera"
    bpy.ops.mphdrr.tidy_modules()
    assert len(bpy.data.meshes) == n_meshes - 2

    select(scanner.module(collection, 4))  # a copy whose original is deleted before tidying takes its place
    bpy.ops.object.duplicate()
    bpy.data.objects.remove(scanner.module(collection, 4))
    update()
    assert collection.mphdrr_scanner.untidy == "1 bare camera, 2 parts without a camera"
    bpy.ops.mphdrr.tidy_modules()
    assert [len(c.children) for c in scanner.modules(collection)] == [2] * 9
    assert scanner.read_scanner(collection).numbers.tolist() == [2, 3, 4, 5, 6, 7, 8, 9, 10]
    assert_consistent(collection)


def test_duplicates_stand_along_the_ring(collection, roi_system):
    select(scanner.module(collection, 2), scanner.module(collection, 6))
    assert bpy.ops.mphdrr.duplicate_modules(count=2, angle=np.radians(12.0)) == {"FINISHED"}
    system = scanner.read_scanner(collection)
    assert system.numbers.tolist() == list(range(1, 13))
    for new, (old, step) in zip(range(8, 12), [(1, 1), (1, 2), (5, 1), (5, 2)], strict=True):
        angle = np.radians(12.0) * step
        c, s = np.cos(angle), np.sin(angle)
        turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ roi_system.centers[old]
        assert np.allclose(system.centers[new], turned, atol=1e-6)
        assert system.pinhole_distance[new] == pytest.approx(roi_system.pinhole_distance[old], abs=1e-6)
    assert np.allclose(system.collimator_length, formula_lengths(system), rtol=1e-12, atol=0)
    assert_consistent(collection)
    refused(bpy.ops.mphdrr.duplicate_modules, "place of another module", count=1, angle=0.0)

    first = [scanner.module(collection, 1)]
    (copy,) = module_edits.duplicate_modules(collection, first, 1, np.radians(30.0), follow_ring=True)
    x, y, z = scanner.read_module(collection, copy).centers[0]
    radii = np.hypot(*roi_system.centers[:2, :2].T)
    assert min(radii) < np.hypot(x, y) < max(radii) and z == pytest.approx(-30.0)
    update()
    assert_consistent(collection)


def test_modules_are_removed_with_their_parts(collection):
    marker = bpy.data.objects.new("Marker", None)
    bpy.context.scene.collection.objects.link(marker)
    marker.parent = scanner.module(collection, 8)
    place = objects.world_matrix(marker)
    select(scanner.module(collection, 2), scanner.module(collection, 8))
    bpy.ops.mphdrr.remove_modules()
    assert scanner.read_scanner(collection).numbers.tolist() == [1, 3, 4, 5, 6, 7]
    assert sum(o.type == "MESH" for o in collection.all_objects) == 13
    assert np.allclose(objects.world_matrix(marker), place, atol=1e-4)
    assert_consistent(collection)
    select(*scanner.modules(collection))
    refused(bpy.ops.mphdrr.remove_modules, "at least one module")


def test_check_marks_the_modules_until_something_changes(collection):
    assert bpy.ops.mphdrr.check_geometry() == {"FINISHED"}
    assert collection.mphdrr_scanner.findings == "[]"
    second = scanner.module(collection, 2)
    center = scanner.read_scanner(collection).centers[0]
    second.location = center * 1.02 + [0.0, 0.0, 9.0]
    update()
    assert collection.mphdrr_scanner.findings == ""
    bpy.ops.mphdrr.check_geometry()
    assert "overlap" in collection.mphdrr_scanner.findings
    marked = {c.mphdrr_module.number for c in scanner.modules(collection) if c.mphdrr_module.finding}
    assert {1, 2} <= marked
    assert {o.mphdrr_module.number for o in bpy.context.selected_objects} == marked
    move(second, x=1.0)
    assert second.mphdrr_module.finding == "" and collection.mphdrr_scanner.findings == ""


def test_files_with_shared_meshes_are_loaded(collection, tmp_path):
    """As an older version saved them."""
    cameras_ = scanner.modules(collection)
    for camera in cameras_[1:]:
        for name in ("COLLIMATOR", "CRYSTAL"):
            part(camera, name).data = part(cameras_[0], name).data
    assert_consistent(scanner.active_scanner(reopened(tmp_path / "old.blend")))


def hole_radii(camera: bpy.types.Object) -> dict[float, float]:
    """Return the radius of the hole by the depth of its corners."""
    points = np.array([v.co for v in part(camera, "COLLIMATOR").data.vertices])
    return {
        float(z): float(np.hypot(*points[points[:, 2] == z, :2].T).min())
        for z in np.unique(points[:, 2])
        if z < camera.mphdrr_module.collimator_length
    }


def test_collimators_of_an_older_file_get_their_knife_edge(collection, tmp_path):
    """Version 0.1.0 drew straight holes, and its scanners know no opening angle."""
    expected = {}
    for camera in scanner.modules(collection):
        mesh, radius = part(camera, "COLLIMATOR").data, camera.mphdrr_module.pinhole_diameter / 2
        expected[camera.mphdrr_module.number] = {-1.0: radius + 1, 0.0: radius, 1.0: radius + 1}
        assert hole_radii(camera) == pytest.approx(expected[camera.mphdrr_module.number], rel=1e-6)
        box = np.array(list(np.ndindex(2, 2, 2)), float)
        mesh.clear_geometry()
        mesh.from_pydata(box.tolist(), [], [[0, 1, 3, 2]])
        mesh["mphdrr_solid"] = "(2.0, 60.0, 50.0, 2.0, 2.0)"
    for name in ("opening_angle", "edge_at"):
        collection.mphdrr_scanner.property_unset(name)
    loaded = scanner.active_scanner(reopened(tmp_path / "old.blend"))
    assert_consistent(loaded)
    for camera in scanner.modules(loaded):
        assert hole_radii(camera) == pytest.approx(expected[camera.mphdrr_module.number], rel=1e-6)


def test_opening_angle_and_place_of_the_edge_are_drawn_exported_and_checked(collection, tmp_path):
    properties, camera = collection.mphdrr_scanner, scanner.modules(collection)[0]
    radius = camera.mphdrr_module.pinhole_diameter / 2
    properties.opening_angle, properties.edge_at = np.radians(20), "FRONT"
    slope = np.tan(np.radians(10))
    assert hole_radii(camera) == pytest.approx({0.0: radius, 2.0: radius + 2 * slope}, rel=1e-6)
    bpy.ops.mphdrr.check_geometry()
    assert "too thick for an opening angle of 20 degrees" in properties.findings
    bpy.ops.mphdrr.export_for_program(format="gate10", filepath=str(tmp_path / "gate"))
    volumes = json.loads((tmp_path / "gate/simulation.json").read_text())["volumes"]
    (back,) = [v for v in volumes if v["name"] == "back_collimator_1"]
    assert back["size_mm"] == pytest.approx([radius + 2 * slope, radius, 2.0], rel=1e-6)
    bpy.ops.mphdrr.export_for_program(format="stl-parts", filepath=str(tmp_path / "stl"))
    assert len(list((tmp_path / "stl").iterdir())) == 2 * properties.count
    properties.opening_angle = 3.0  # with which the hole is wider than the crystal
    assert "choose a thinner plate or a smaller angle" in camera.mphdrr_module.problem
    properties.opening_angle = np.radians(90)
    assert camera.mphdrr_module.problem == ""


def test_only_what_has_changed_is_rebuilt(collection, monkeypatch):
    reshaped, reshape = [], collimators.reshape_mesh
    monkeypatch.setattr(collimators, "reshape_mesh", lambda mesh, solid: (reshaped.append(mesh), reshape(mesh, solid)))
    following.refresh(collection)
    assert reshaped == []
    camera = scanner.module(collection, 3)
    camera.location *= 1.01
    update()
    assert set(reshaped) == {part(camera, "COLLIMATOR").data, part(camera, "CRYSTAL").data} and len(reshaped) == 2
    collection.mphdrr_scanner.detector_thickness = 11.0
    assert len(reshaped) == 2 + 8 and all(mesh.name.startswith("Crystal") for mesh in reshaped[2:])
