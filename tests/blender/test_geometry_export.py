"""Scene to workbook and to other programs: what is written agrees with the scene, which then counts as saved."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import jobs
from mphdrr.addon.scanner import module_edits, scanner
from mphdrr.addon.scanner.scanner_files import export_workbook_job
from mphdrr.core.errors import InputWarning
from mphdrr.core.exchange import FORMATS, read_geometry
from mphdrr.core.workbook import read_system

from .conftest import assert_same, refused, update


@pytest.fixture
def own(small_workbook, tmp_path) -> Path:
    return Path(shutil.copy(small_workbook, tmp_path / "own.xlsx"))


@pytest.fixture
def collection(scene, own):
    bpy.ops.mphdrr.import_geometry(filepath=str(own))
    return scanner.active_scanner(scene)


def test_unchanged_scanner_writes_the_same_file(scene, workbook, tmp_path):
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    collection, path = scanner.active_scanner(scene), tmp_path / "again.xlsx"
    assert bpy.ops.mphdrr.export_geometry(filepath=str(path)) == {"FINISHED"}
    assert path.read_bytes() == workbook.read_bytes()
    assert collection.mphdrr_scanner.workbook == str(path)


def random_edits(rng: np.random.Generator, collection: bpy.types.Collection) -> None:
    """Edit a scanner at random for a user's afternoon: moves, numbers, copies, deletions."""
    for _ in range(12):
        found = scanner.modules(collection)
        camera = found[rng.integers(len(found))]
        module = camera.mphdrr_module
        match rng.integers(7):
            case 0:
                camera.location = np.array(camera.location) * rng.uniform(0.95, 1.1) + rng.normal(size=3)
            case 1:
                module.pinhole_diameter = rng.uniform(1.0, 5.0)
            case 2:
                module.roi_radius = rng.uniform(60.0, 80.0)
            case 3:
                module.collimator_length = rng.uniform(40.0, 90.0)
            case 4:
                module_edits.duplicate_modules(collection, [camera], 1, rng.uniform(0.01, 0.03), bool(rng.integers(2)))
            case 5:
                module_edits.remove_modules(collection, [camera])
            case 6:
                module.detector_side, module.detector_thickness = rng.uniform(40.0, 60.0), rng.uniform(5.0, 12.0)
        update()


@pytest.mark.parametrize(("seed", "use_template"), [(0, True), (2, False)])
def test_random_edits_come_back_from_the_workbook(scene, collection, tmp_path, seed, use_template):
    rng = np.random.default_rng(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        for turn in range(2):  # the second time the first file is the template
            random_edits(rng, collection)
            system = scanner.read_scanner(collection)
            path = tmp_path / f"{turn}.xlsx"
            bpy.ops.mphdrr.export_geometry(filepath=str(path), use_template=use_template)
            assert_same(read_system(path), system, 1e-9)
            assert_same(scanner.read_scanner(collection), system, 1e-9)
            assert scanner.losses(collection) == []
            assert scanner.read_scanner(collection).source.path == path
    bpy.ops.mphdrr.import_geometry(filepath=str(path), name=collection.mphdrr_scanner.scanner_name)
    assert_same(scanner.read_scanner(collection), system, 1e-9)


def test_modules_keep_the_order_of_the_workbook_and_added_ones_come_last(collection, tmp_path):
    module_edits.duplicate_modules(collection, [scanner.module(collection, 5)], 1, 0.02, follow_ring=False)
    module_edits.remove_modules(collection, [scanner.module(collection, 2)])
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "a.xlsx"))
    assert read_system(tmp_path / "a.xlsx").numbers.tolist() == [1, *range(3, 18)]
    assert not scanner.module(collection, 17).mphdrr_module.added


def test_a_turned_camera_is_a_tilted_module_in_the_workbook(collection, own):
    """Also in a script that does not update the view layer first."""
    scanner.module(collection, 7).rotation_euler.y += 0.1
    bpy.ops.mphdrr.export_geometry(filepath=str(own), use_template=False)
    tilted = read_system(own)
    assert_same(tilted, scanner.read_scanner(collection), 1e-9)
    assert np.flatnonzero(np.any(tilted.tilt, axis=1)).tolist() == [6]
    bpy.ops.mphdrr.aim_modules()
    scanner.module(collection, 12).location.z += 2.5
    bpy.ops.mphdrr.export_geometry(filepath=str(own))
    aimed = read_system(own)
    assert_same(aimed, scanner.read_scanner(collection), 1e-9)
    assert not aimed.tilt.any() and aimed.centers[11, 2] == pytest.approx(tilted.centers[11, 2] + 2.5, abs=1e-5)


def test_template_that_has_gone_is_said(collection, own, tmp_path):
    own.unlink()
    scanner.module(collection, 3).mphdrr_module.pinhole_diameter = 2.9
    system = scanner.read_scanner(collection)
    with pytest.warns(InputWarning, match=r"own\.xlsx has gone"):
        jobs.run(export_workbook_job(collection, tmp_path / "new.xlsx"))
    assert_same(read_system(tmp_path / "new.xlsx"), system, 1e-9)


def test_bad_paths_are_one_line_and_leave_the_scanner(collection, tmp_path):
    source = collection.mphdrr_scanner.source
    for name in ("", "no/such/folder.xlsx", "wrong.ods"):
        refused(bpy.ops.mphdrr.export_geometry, "", filepath=str(tmp_path / name) if name else "")
    assert collection.mphdrr_scanner.source == source


def test_every_format_of_other_programs_is_written(imported, tmp_path):
    for name, format in FORMATS.items():
        path = tmp_path / f"{name}{(format.suffixes or ('',))[0]}"
        assert bpy.ops.mphdrr.export_for_program(format=name, filepath=str(path)) == {"FINISHED"}
        files = list(path.iterdir()) if path.is_dir() else [path]
        assert files and all(file.stat().st_size > 0 for file in files)


def test_other_programs_get_the_scene_as_it_stands_with_its_tilted_modules(imported, scene, tmp_path):
    scanner.module(imported, 3).location[0] += 5.0
    scanner.module(imported, 7).rotation_euler[1] += 0.1
    scene.mphdrr_projections.width, scene.mphdrr_projections.height = 40, 30
    path = tmp_path / "record.json"
    bpy.ops.mphdrr.export_for_program(format="mphdrr", filepath=str(path))
    (system, views), expected = read_geometry(path), scanner.read_scanner(imported)
    assert np.array_equal(system.centers, expected.centers) and views.shape == (30, 40)
    assert np.array_equal(system.tilt, expected.tilt) and np.flatnonzero(np.any(system.tilt, axis=1)).tolist() == [6]
    assert np.linalg.norm(system.tilt[6]) == pytest.approx(0.1, abs=0.05)
