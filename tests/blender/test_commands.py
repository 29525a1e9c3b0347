"""The commands and the example that make scenes, as users run them, once in a new process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.addon.pictures import images
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(*words: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture
def small_run(tmp_path, dc_spect) -> Path:
    system = dc_spect[[0, 30, 79]]
    volume = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40).voxelize(mph.Grid.centered(24, 4.0))
    views = system.views(shape=(12, 16))
    path = tmp_path / "small.h5"
    mph.write_run(mph.ProjectionRun(mph.Projector(volume.grid, views)(volume), system, views, volume), path)
    return path


def test_scene_command_saves_scanner_volume_and_projections(tmp_path, workbook, small_run):
    blend = tmp_path / "new" / "scanner.blend"
    run("-m", "mphdrr", "scene", workbook, "--run", small_run, "-o", blend)
    assert {path.name for path in blend.parent.iterdir()} == {"scanner.blend", "scanner_mphdrr"}

    bpy.ops.wm.open_mainfile(filepath=str(blend))
    collection = scanner.active_scanner(bpy.context.scene)
    assert np.array_equal(scanner.read_scanner(collection).centers, mph.read_system(workbook).centers)
    expected = mph.read_run(small_run)
    (item,) = volumes.volume_objects(bpy.context.scene)
    assert np.array_equal(volumes.volume_from_object(item).array, expected.volume.array)
    shown = [image for image in bpy.data.images if tuple(image.size) == (16, 12) and image.is_float]
    assert len(shown) == 3
    assert np.array_equal(images.projection_array(shown[0]), expected.projections[0])


def test_scene_command_takes_a_volume_of_mu(tmp_path, workbook):
    mu = mph.Volume(np.full((3, 4, 5), 0.0154, np.float32), mph.Grid.centered((3, 4, 5), 30.0), "mu")
    mph.write_volume(mu, tmp_path / "mu.nii")
    words = ["scene", workbook, "--modules", "1-2", "--mu", tmp_path / "mu.nii", "-o", tmp_path / "s.blend"]
    assert main(list(map(str, words))) == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "s.blend"))
    shown = volumes.volume_from_object(bpy.context.scene.mphdrr_projections.mu)
    assert shown.quantity == "mu" and np.array_equal(shown.array, mu.array)
    np.testing.assert_allclose(shown.grid.affine, mu.grid.affine, atol=1e-4)


def test_scene_command_refuses_in_one_line(tmp_path, workbook, capsys):
    volume = tmp_path / "a.nii"
    mph.write_volume(mph.Volume(np.ones((2, 2, 2)), mph.Grid.centered(2, 1.0), "activity"), volume)
    for name, options, words in (
        ("s.txt", [], "expected a name ending in .blend"),
        ("s.blend", ["--mu", str(volume)], "a.nii: it holds activity, expected mu in 1/mm"),
    ):
        assert main(["scene", str(workbook), *options, "-o", str(tmp_path / name)]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and words in said
    assert list(tmp_path.iterdir()) == [volume]


@pytest.mark.long
def test_examples_run(tmp_path, workbook, small_run):
    said = run(EXAMPLES / "batch.py", workbook, tmp_path / "batch")
    assert {path.name for path in (tmp_path / "batch").iterdir()} >= {"run.npz", "scanner.blend", "scanner_mphdrr"}
    assert "Traceback" not in said.stderr
    assert "modules" in run(EXAMPLES / "package.py").stdout
    assert "projections" in run(EXAMPLES / "read_run.py", small_run).stdout
