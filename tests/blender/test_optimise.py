"""Design > Optimise: the scanner in the scene is that of `mph.design.optimize`; Cancel and one undo take it back."""

from __future__ import annotations

import json
import sys

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import jobs
from mphdrr.addon.scanner import optimising, scanner
from mphdrr.core.cli import main

from .conftest import assert_same, refused, update
from .test_jobs import everything

pytest.importorskip("scipy", reason="no scipy")

TEXT = """
version = 1

[generator]
kind = "ellipse"
modules = 3
semi_axes = [150, 140]
start = 10
end = 250
z = [-28, 31]
pinhole_diameter = 4
detector_side = 50
detector_thickness = 8
roi_radius = 26

[free]
semi_axes = [[110, 200], [110, 200]]
z = [[-60, -20], [20, 60]]
pinhole_diameter = [1, 9]

[[objectives]]
kind = "detail"
size = 8
points = 5

[search]
starts = 1
coarse_steps = 3
steps = 1
"""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    path = tmp_path_factory.mktemp("design") / "small.toml"
    path.write_text(TEXT)
    return path


@pytest.fixture(scope="module")
def found(recipe):
    return mph.design.optimize(recipe)


@pytest.fixture
def at_once(monkeypatch, found):
    """Replace the search by one that returns `found` at once."""

    def optimize(recipe, progress, callback):
        callback(found.start, 0.0)
        return found

    monkeypatch.setattr(optimising, "optimize", optimize)


@pytest.fixture
def like(found):
    """Return a scanner with modules of the same numbers, as from a workbook."""
    return found.start.replace(pinhole_diameter=np.full(6, 3.3), roi_radius=np.full(6, 20.0))


def test_the_scene_is_what_script_and_command_find(scene, recipe, found, tmp_path):
    assert bpy.ops.mphdrr.optimise(filepath=str(recipe)) == {"FINISHED"}
    collection = scanner.active_scanner(scene)
    assert collection.name == "small"
    assert_same(scanner.read_scanner(collection), found.system)
    assert main(["design", "optimize", str(recipe), "-o", str(tmp_path / "command.xlsx"), "--quiet"]) == 0
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "window.xlsx"))
    command, window = (mph.read_system(tmp_path / f"{name}.xlsx") for name in ("command", "window"))
    assert_same(command, window)
    assert np.allclose(window.centers, found.system.centers, rtol=2e-9)
    lines = json.loads(collection.mphdrr_scanner.design)
    assert lines == found.summary() and "at the start, now" in lines[-2]


def test_a_scanner_with_these_modules_becomes_it(scene, recipe, found, at_once, like, tmp_path):
    mph.write_system(like, tmp_path / "mine.xlsx")
    bpy.ops.mphdrr.import_geometry(filepath=str(tmp_path / "mine.xlsx"))
    cameras = scanner.modules(scanner.active_scanner(scene))
    bpy.ops.mphdrr.optimise(filepath=str(recipe))
    (collection,) = scanner.scanners(scene)
    assert scanner.modules(collection) == cameras
    assert_same(scanner.read_scanner(collection), found.system)
    assert scanner.losses(collection) == ["a design that no workbook has"]
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "new.xlsx"))
    assert scanner.losses(collection) == []


def test_one_of_other_modules_stays_beside_it(scene, recipe, found, at_once, ring_system):
    ring = scanner.build_scanner(scene, ring_system, "small")
    bpy.ops.mphdrr.optimise(filepath=str(recipe))
    assert [c.mphdrr_scanner.scanner_name for c in scanner.scanners(scene)] == ["small", "small 2"]
    assert_same(scanner.read_scanner(ring), ring_system)
    assert_same(scanner.read_scanner(scanner.active_scanner(scene)), found.system)


def moved(scene, recipe, looks: int) -> tuple[jobs.Job, list[mph.PinholeSystem]]:
    """Run a job whose search is shown so many times and then cancelled; return it and the scanners that were seen."""
    job, seen = optimising.optimize_job(scene, recipe), []

    def work(done, total):
        job.refresh()
        collections = scanner.scanners(scene)
        seen.append(scanner.read_scanner(collections[-1]) if collections else None)
        if len(seen) == looks:
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        job.work(work)
    return job, seen


@pytest.mark.parametrize(
    "has", ["none", *(pytest.param(has, marks=pytest.mark.long) for has in ("these modules", "other modules"))]
)
def test_it_moves_while_it_works_and_cancelling_takes_all_back(scene, recipe, like, ring_system, has):
    scene.render.resolution_x, scene.camera = 777, None
    if has != "none":
        scanner.build_scanner(scene, like if has == "these modules" else ring_system, "Mine")
    update()
    before = everything()
    job, seen = moved(scene, recipe, 14)
    steps = {system.pinhole_diameter[0] for system in seen if system is not None}
    assert len(steps) > 2 and everything() != before
    job.discard()
    assert everything() == before


def test_finishing_early_keeps_the_best_so_far(scene, recipe):
    job = optimising.optimize_job(scene, recipe)

    def progress(done, total):
        assert done < 4
        if done == 2:
            job.finish_now.set()

    assert "stopped after 3 steps" in jobs.run(job, progress)
    half = json.loads(scanner.active_scanner(scene).mphdrr_scanner.design)
    first, last = (float(word) for word in half[-2].partition(": ")[2].replace(" at the start, now", "").split())
    assert last > first


def test_one_undo_takes_it_back(scene, recipe, found, at_once, like):
    scanner.build_scanner(scene, like, "Mine")
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.mphdrr.optimise(filepath=str(recipe))
    bpy.ops.ed.undo_push(message="optimised")
    bpy.ops.ed.undo()
    collection = scanner.active_scanner(bpy.context.scene)
    assert not collection.mphdrr_scanner.design
    assert_same(scanner.read_scanner(collection), like)
    bpy.ops.ed.redo()
    assert_same(scanner.read_scanner(scanner.active_scanner(bpy.context.scene)), found.system)


def test_faults_are_said_and_marked(scene, recipe, tmp_path):
    path = tmp_path / "crowded.toml"
    path.write_text(TEXT.replace("[search]", "[constraints]\nbore = 250\n\n[search]"))
    with pytest.warns(mph.InputWarning, match="into the bore"):
        text = jobs.run(optimising.optimize_job(scene, path))
    assert "not a good scanner" in text
    assert "into the bore" in json.loads(scanner.active_scanner(scene).mphdrr_scanner.design)[-1]


def test_one_line_says_what_is_wrong(scene, recipe, tmp_path, monkeypatch):
    (tmp_path / "bad.toml").write_text(TEXT.replace('"detail"', '"beauty"'))
    for path, said in (("", "no file given: set filepath to a design"), (tmp_path / "bad.toml", "kind 'beauty'")):
        refused(bpy.ops.mphdrr.optimise, said, filepath=str(path))
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    refused(bpy.ops.mphdrr.optimise, r"scipy is missing: pip install \"mphdrr\[design\]\"", filepath=str(recipe))
    assert not scanner.scanners(scene)
