"""The scene's scanner for other programs."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.addon.scanner import scanner
from mphdrr.core.exchange import FORMATS, read_geometry


@pytest.fixture
def collection(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    return scanner.active_scanner(scene)


def test_every_format(collection, tmp_path):
    for name, format in FORMATS.items():
        path = tmp_path / f"{name}{(format.suffixes or ('',))[0]}"
        assert bpy.ops.mphdrr.export_for_program(format=name, filepath=str(path)) == {"FINISHED"}
        files = list(path.iterdir()) if path.is_dir() else [path]
        assert files and all(file.stat().st_size > 0 for file in files)


def test_it_is_the_scene_as_it_stands(collection, scene, tmp_path):
    scanner.module(collection, 3).location[0] += 5.0
    scene.mphdrr_projections.width, scene.mphdrr_projections.height = 40, 30
    path = tmp_path / "record.json"
    bpy.ops.mphdrr.export_for_program(format="mphdrr", filepath=str(path))
    system, views = read_geometry(path)
    assert np.array_equal(system.centers, scanner.read_scanner(collection).centers)
    assert views.shape == (30, 40)


def test_a_turned_camera_is_written_as_a_tilted_module(collection, tmp_path):
    scanner.module(collection, 7).rotation_euler[1] += 0.1
    bpy.ops.mphdrr.export_for_program(format="mphdrr", filepath=str(tmp_path / "a.json"))
    system, _ = read_geometry(tmp_path / "a.json")
    expected = scanner.read_scanner(collection)
    assert np.array_equal(system.tilt, expected.tilt) and np.flatnonzero(np.any(system.tilt, axis=1)).tolist() == [6]
    assert np.linalg.norm(system.tilt[6]) == pytest.approx(0.1, abs=0.05)
