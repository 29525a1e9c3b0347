"""Geometry > Calibrate: the scanner in the scene is that of `mph.calibrate`, and one undo takes it back."""

from __future__ import annotations

import json
import sys

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import ids
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import arrows, scanner
from mphdrr.core.cli import main

pytest.importorskip("scipy", reason="no scipy")

from mphdrr.core.design.calibration_recipe import run_calibration

from .conftest import refused

POINTS = 38.0 * np.array([[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
SHAPE, FWHM = (32, 32), 2.0
WRONG = 31  # the number of the module whose images are upside down


@pytest.fixture(scope="module")
def nominal(dc_spect) -> mph.PinholeSystem:
    return dc_spect[::10]


@pytest.fixture(scope="module")
def images(nominal):
    """Return counts (5, 8, 32, 32) of modules off by 1 mm and 0.5 degrees; those of one are upside down."""
    rng = np.random.default_rng(3)
    off = {"centers": nominal.centers + rng.normal(0, 1, (8, 3)), "tilt": np.radians(rng.normal(0, 0.5, (8, 3)))}
    true = nominal.replace(**off)
    expected = mph.point_images(mph.Emission(true, intrinsic_fwhm=FWHM), true.views(SHAPE), POINTS)
    counts = rng.poisson(expected * 20_000 / expected.sum((2, 3), keepdims=True))
    counts[:, nominal.numbers == WRONG] = counts[:, nominal.numbers == WRONG, ::-1]
    return counts


@pytest.fixture(scope="module")
def recipe(nominal, images, tmp_path_factory):
    folder = tmp_path_factory.mktemp("points")
    mph.write_system(nominal, folder / "nominal.xlsx")
    model = mph.Recipe({"model.kind": "emission", "model.intrinsic_fwhm": FWHM})
    for k, upright in enumerate(images):
        numbers = nominal.numbers.tolist()
        run = mph.counts_run(upright[:, ::-1, ::-1], nominal, numbers, "back-v", 60.0, recipe=model)
        mph.write_run(run, folder / f"{k}.h5")
    path = folder / "points.toml"
    files, points = json.dumps([f"{k}.h5" for k in range(5)]), json.dumps(POINTS.tolist())
    path.write_text(f"[runs]\nfiles = {files}\n[system]\nfile = 'nominal.xlsx'\n[sources]\npoints = {points}\n")
    return path


@pytest.fixture(scope="module")
def found(recipe):
    return run_calibration(recipe)


@pytest.fixture
def collection(scene, recipe):
    bpy.ops.mphdrr.import_geometry(filepath=str(recipe.with_name("nominal.xlsx")))
    return scanner.active_scanner(scene)


def test_the_scene_is_what_script_and_command_find(collection, recipe, found, nominal, images, tmp_path):
    assert bpy.ops.mphdrr.calibrate(filepath=str(recipe)) == {"FINISHED"}
    model = mph.Emission(nominal, intrinsic_fwhm=FWHM)
    script = mph.calibrate(nominal, images, nominal.views(SHAPE), POINTS, model=model).system
    assert main(["geometry", "calibrate", str(recipe), "-o", str(tmp_path / "found.xlsx")]) == 0
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "exported.xlsx"))
    with pytest.warns(mph.InputWarning, match="the formula gives"):
        written = [mph.read_system(tmp_path / name) for name in ("found.xlsx", "exported.xlsx")]
    for system in (script, *written, scanner.read_scanner(collection)):
        assert np.allclose(system.centers, found.system.centers, rtol=0, atol=2e-5)
        assert np.allclose(system.tilt, found.system.tilt, rtol=0, atol=2e-6)  # float32 in the scene
        assert np.allclose(system.collimator_length, nominal.collimator_length, rtol=1e-12)
    assert not collection.mphdrr_scanner.keep_aimed and np.abs(written[1].tilt).max() > 0.002


def test_lines_marks_and_picture_say_what_was_found(collection, recipe, found):
    bpy.ops.mphdrr.calibrate(filepath=str(recipe))
    lines = json.loads(collection.mphdrr_scanner.calibration)
    assert lines[:-1] == found.summary() and lines[0].startswith("7 of 8 modules moved, RMS 1.")
    assert lines[2] == f"modules that do not fit: {WRONG}" and lines[-1].startswith("arrows: 2")
    for camera in scanner.modules(collection):
        assert bool(camera.mphdrr_module.finding) == (camera.mphdrr_module.number == WRONG)
    assert bpy.data.images[ids.RESIDUALS].size[0] > 100


def test_arrows_lead_from_nominal_to_found_places_once(collection, recipe, found):
    for factor in (20.0, 30.0):
        bpy.ops.mphdrr.calibrate(filepath=str(recipe), exaggeration=factor)
        (item,) = [o for o in bpy.data.objects if o.mphdrr_module.part == "ARROWS"]
    moved = found.system.numbers != WRONG
    start, end = (system.centers[moved] for system in (found.nominal, found.system))
    ends = np.array([[spline.points[i].co[:3] for i in (0, -1)] for spline in item.data.splines])
    assert np.allclose(ends, np.stack([start, start + 30 * (end - start)], axis=1), atol=1e-4)
    assert item.name in collection.objects and len(bpy.data.curves) == 1
    assert not any("yours" in line for line in scanner.losses(collection))


def test_the_longest_arrow_is_about_50_mm_by_default(collection):
    starts = np.array([[0.0, 0, 5], [1, 2, 3]])
    assert arrows.show(collection, starts, starts + np.diag([0.3, 0, 1.1])[::2]) == 50
    assert max(bpy.data.objects[ids.ARROWS].dimensions) == pytest.approx(55, abs=8)
    assert arrows.show(collection, starts, starts) == 0 and ids.ARROWS not in bpy.data.objects


def test_one_undo_takes_it_back_and_runs_become_stale(scene, collection, recipe, nominal, tmp_path):
    np.save(tmp_path / "counts.npy", np.ones((8, 4, 4), int))
    numbers = ",".join(map(str, nominal.numbers))
    said = {"frames": numbers, "orientation": "back-v", "time": 1.0}
    bpy.ops.mphdrr.import_counts(filepath=str(tmp_path / "counts.npy"), **said)
    assert not runs.changes(scene)
    bpy.ops.ed.undo_push(message="imported")
    bpy.ops.mphdrr.calibrate(filepath=str(recipe), apply=False)
    assert not runs.changes(scene) and ids.ARROWS in bpy.data.objects
    assert np.array_equal(scanner.read_scanner(collection).centers, nominal.centers)
    bpy.ops.mphdrr.calibrate(filepath=str(recipe))
    assert runs.changes(scene)
    bpy.ops.ed.undo_push(message="calibrated")
    bpy.ops.ed.undo()
    collection = scanner.active_scanner(bpy.context.scene)
    read = scanner.read_scanner(collection)
    assert np.array_equal(read.centers, nominal.centers) and not read.tilt.any()
    assert ids.ARROWS not in bpy.data.objects and not collection.mphdrr_scanner.calibration
    assert collection.mphdrr_scanner.keep_aimed and not runs.changes(bpy.context.scene)


def test_another_scanner_is_refused_and_stays(scene, recipe, nominal, ring_system):
    for system, message in ((nominal[:7], "has no module 71"), (ring_system, "has no module 1 within")):
        collection = scanner.build_scanner(scene, system, "Other", replace=True)
        refused(bpy.ops.mphdrr.calibrate, f"{message}.*choose the recipe", filepath=str(recipe))
        assert np.array_equal(scanner.read_scanner(collection).centers, system.centers)
        assert ids.ARROWS not in bpy.data.objects


def test_one_line_says_what_is_missing(collection, recipe, monkeypatch):
    refused(bpy.ops.mphdrr.calibrate, "no file given: set filepath to a calibration recipe")
    monkeypatch.setitem(sys.modules, "scipy.ndimage", None)
    refused(bpy.ops.mphdrr.calibrate, "scipy", filepath=str(recipe))
