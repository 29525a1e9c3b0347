"""Runs from and for files: measured counts become the shown run, a flood the efficiencies, and a run a dataset."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import ids, storage
from mphdrr.addon.pictures import images
from mphdrr.addon.runs import runs
from mphdrr.addon.volumes import volumes
from mphdrr.core.cli import main
from mphdrr.core.physics.energy_window import energy_window_scatter
from mphdrr.core.runs.files import read_run
from mphdrr.core.runs.recipe import read_recipe
from mphdrr.core.runs.reconstructing import reconstruct_run

from .conftest import refused, update

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def counts(tmp_path) -> np.ndarray:
    frames = np.random.default_rng(2).poisson(5.0, (8, 6, 6))
    np.save(tmp_path / "counts.npy", frames)
    return frames


SAID = {"frames": "8-1", "orientation": "back-v", "time": 60.0}


def test_counts_become_the_shown_run(ring, ring_system, counts, scene, tmp_path):
    settings = scene.mphdrr_projections
    settings.model = "EMISSION"
    settings.isotope, settings.width, settings.detector = "Tc-99m", 99, "VIRTUAL"
    path = str(tmp_path / "counts.npy")
    assert bpy.ops.mphdrr.import_counts(filepath=path, **SAID) == {"FINISHED"}
    run = read_run(storage.absolute(settings.run_file))
    np.testing.assert_array_equal(run.projections, counts[::-1])
    np.testing.assert_allclose(run.system.centers, ring_system.centers, rtol=1e-12)
    assert (run.volume, run.unit, run.settings["orientation"]) == (None, "counts", "back-v")
    assert (run.recipe["model.isotope"], run.recipe["model.time"]) == ("Tc-99m", 60.0)
    for m, number in enumerate(run.system.numbers):
        assert np.array_equal(images.projection_array(bpy.data.images[ids.projection_name(number, 8)]), counts[7 - m])
    assert len(settings.runs) == 1 and settings.runs[0].name == "SPECT Counts, 6 × 6, counts.npy"
    assert runs.measured_text(scene).startswith("counts.npy, 60 s, frames back-v.") and not runs.changes(scene)
    assert runs.volume_to_render(scene) == ""
    bpy.data.objects["Module 03"].location.x += 1.0
    update()
    assert runs.changes(scene) == ["Module 03 moved"]
    assert bpy.ops.mphdrr.export_dataset(filepath=str(tmp_path / "out.npz")) == {"FINISHED"}
    assert read_run(tmp_path / "out.npz").volume is None
    settings.runs[0].keep = True
    assert bpy.ops.mphdrr.import_counts(filepath=path, **(SAID | {"frames": "1-8"})) == {"FINISHED"}
    assert bpy.ops.mphdrr.compare_runs(other="0") == {"FINISHED"}
    assert bpy.ops.mphdrr.load_recipe(filepath=str(tmp_path / "out.npz")) == {"FINISHED"}
    assert (settings.model, settings.time, settings.detector) == ("EMISSION", 60.0, "REAL")


def test_a_measured_study_is_the_run_of_its_recipe(scene, tmp_path):
    """All corrections at once, by the window as by the command (docs/measured-studies.md)."""
    spec = importlib.util.spec_from_file_location("measured_study", EXAMPLES / "measured_study.py")
    study = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(study)
    study.write_study(tmp_path, modules=6, pixels=12)
    recipe = read_recipe(tmp_path / "study.toml")
    study.find_efficiency(tmp_path, recipe)
    assert bpy.ops.mphdrr.import_geometry(filepath=str(tmp_path / "scanner.xlsx")) == {"FINISHED"}
    assert bpy.ops.mphdrr.import_volume(filepath=str(tmp_path / "water.nii.gz"), quantity="mu") == {"FINISHED"}
    assert bpy.ops.mphdrr.load_recipe(filepath=str(tmp_path / "study.toml")) == {"FINISHED"}
    scene.mphdrr_projections.mu = bpy.context.object
    names = "frames", "lower_frames", "upper_frames", "scatter_fwhm"
    given = {name: recipe[f"counts.{name}"] for name in names} | {"orientation": "back-v"}
    assert bpy.ops.mphdrr.import_counts(filepath=str(tmp_path / "scan.dcm"), **given) == {"FINISHED"}
    run, (own,) = read_run(storage.absolute(scene.mphdrr_projections.run_file)), study.runs_of(recipe)
    for name in ("projections", "background", "efficiency"):
        np.testing.assert_array_equal(getattr(run, name), getattr(own, name))
    for name in ("time", "start", "dead_time", "isotope"):
        assert run.recipe[f"model.{name}"] == own.recipe[f"model.{name}"]
    settings = scene.mphdrr_reconstruction
    settings.iterations, settings.subsets, settings.voxels, settings.spacing = 2, 2, 8, 20.0
    assert bpy.ops.mphdrr.reconstruct() == {"FINISHED"}
    said = {"iterations": 2, "subsets": 2, "voxels": 8, "spacing": 20.0}
    found = reconstruct_run(own, recipe.updated({f"reconstruction.{name}": value for name, value in said.items()}))
    shown = volumes.volume_from_object(settings.volume)
    np.testing.assert_allclose(shown.array, found.volume.array, rtol=2e-2, atol=1e-2 * found.volume.array.max())


def test_the_files_own_times_are_taken(ring, ring_system, counts, scene, tmp_path):
    frames = "".join(
        f"!image duration (sec) := {10 + k}\nimage relative start time (sec) := {100 * k}\n" for k in range(8)
    )
    sizes = "matrix size [1] := 6\nmatrix size [2] := 6\n"
    matrix = f"{sizes}number format := unsigned integer\nnumber of bytes per pixel := 2\n"
    start = "!INTERFILE :=\nname of data file := c.sin\nimagedata byte order := LITTLEENDIAN\n"
    (tmp_path / "c.hdr").write_text(f"{start}{matrix}{frames}")
    counts.astype("<u2").tofile(tmp_path / "c.sin")
    settings = scene.mphdrr_projections
    settings.model, settings.isotope, settings.start, settings.time = "EMISSION", "Tc-99m", 60.0, 600.0
    assert bpy.ops.mphdrr.import_counts(filepath=str(tmp_path / "c.hdr"), **(SAID | {"time": 0.0})) == {"FINISHED"}
    run = read_run(storage.absolute(settings.run_file))
    assert run.recipe["model.time"] == tuple(range(17, 9, -1))
    assert run.recipe["model.start"] == tuple(range(760, 59, -100))
    refused(bpy.ops.mphdrr.import_counts, "leave it out to take the file's", filepath=str(tmp_path / "c.hdr"), **SAID)


def test_frames_of_some_modules_from_several_files(ring, scene, tmp_path):
    for number in (3, 4):
        np.save(tmp_path / f"head{number}.npy", np.full((4, 4), number))
    said = {"frames": "3,4", "orientation": "front+u", "time": 5.0, "modules": "3-4", "pixel": 2.0}
    files = [{"name": "head4.npy"}, {"name": "head3.npy"}]
    given = {"filepath": str(tmp_path / "head3.npy"), "directory": str(tmp_path), "files": files}
    assert bpy.ops.mphdrr.import_counts(**given, **said) == {"FINISHED"}
    run = read_run(storage.absolute(scene.mphdrr_projections.run_file))
    assert run.projections.mean(axis=(1, 2)).tolist() == [3, 4] and run.system.numbers.tolist() == [3, 4]
    assert run.recipe["detector.pitch"] == 2.0 and not runs.changes(scene)


def test_frames_of_other_energy_windows_give_the_background(ring, scene, tmp_path):
    frames = np.random.default_rng(3).poisson(5.0, (24, 6, 6))
    np.save(tmp_path / "tew.npy", frames)
    said = SAID | {"frames": "1-8, none*16", "lower_frames": "none*8, 1-8, none*8", "upper_frames": "none*16, 1-8"}
    refused(bpy.ops.mphdrr.import_counts, "how wide the energy windows are", filepath=str(tmp_path / "tew.npy"), **said)
    widths = {"window_widths": (4.0, 28.0, 7.0), "scatter_fwhm": 2.0}
    assert bpy.ops.mphdrr.import_counts(filepath=str(tmp_path / "tew.npy"), **said, **widths) == {"FINISHED"}
    run = read_run(storage.absolute(scene.mphdrr_projections.run_file))
    peak, lower, upper = frames.reshape(3, 8, 6, 6)
    expected, _ = energy_window_scatter(lower, peak, upper, (4.0, 28.0, 7.0), 2.0)
    np.testing.assert_allclose(run.background, expected, rtol=1e-6)
    assert run.recipe["counts.scatter_fwhm"] == 2.0


def test_what_is_not_said_is_asked_for(ring, counts, scene, tmp_path):
    usual, import_counts = {"filepath": str(tmp_path / "counts.npy")} | SAID, bpy.ops.mphdrr.import_counts
    for changes, words in (
        ({"frames": ""}, "8 frames of 6 x 6 pixels; say which module each frame is of"),
        ({"orientation": "NONE"}, "say how frames lie on the crystal"),
        ({"time": 0.0}, "say the exposure time in seconds"),
        ({"frames": "1-7,7"}, "module 7 has several frames"),
        ({"filepath": ""}, "no file given"),
    ):
        refused(import_counts, words, **(usual | changes))
    assert not scene.mphdrr_projections.runs
    bpy.ops.mphdrr.remove_scanner()
    refused(import_counts, "scanner", **usual)


def test_a_flood_becomes_the_panels_efficiencies(scene, ring, tmp_path, capsys):
    frames = np.random.default_rng(2).poisson(2000.0, (8, 12, 12))
    frames[3] = 0
    frames[1, 4, 5] = 0
    np.save(tmp_path / "flood.npy", frames)
    assert not bpy.ops.mphdrr.flood_efficiency.poll()
    settings = scene.mphdrr_projections
    settings.model = "EMISSION"
    bpy.ops.mphdrr.import_counts(filepath=str(tmp_path / "flood.npy"), frames="1-8", orientation="front+v", time=60.0)
    run = storage.absolute(settings.run_file)
    assert bpy.ops.mphdrr.flood_efficiency(filepath=str(tmp_path / "e.npy"), order=0) == {"FINISHED"}
    assert main(["counts", "flood", str(run), "--order", "0", "-o", str(tmp_path / "by_command.npy")]) == 0
    assert (tmp_path / "e.npy").read_bytes() == (tmp_path / "by_command.npy").read_bytes()
    efficiency = np.load(tmp_path / "e.npy")
    assert not efficiency[3].any() and (efficiency == 0).sum() == 145 and (efficiency[1] == 0).sum() == 1
    assert runs.panel_recipe(scene)["model.efficiency"] == str(tmp_path / "e.npy")
    refused(bpy.ops.mphdrr.flood_efficiency, "npy", filepath=str(tmp_path / "e.txt"))


@pytest.fixture
def rendered(scene, derenzo):
    bpy.ops.mphdrr.render_projections(width=8, height=6)
    return scene


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".pt"])
def test_dataset_holds_the_run_whole(rendered, tmp_path, suffix, ring_system):
    if suffix == ".pt":
        pytest.importorskip("torch", reason=".pt files need torch")
    path = tmp_path / f"run{suffix}"
    assert bpy.ops.mphdrr.export_dataset(filepath=str(path)) == {"FINISHED"}
    run = read_run(path)
    kept = read_run(rendered.mphdrr_projections.run_file)
    assert np.array_equal(run.projections, kept.projections) and run.projections.shape == (8, 6, 8)
    assert np.array_equal(run.volume.array, volumes.volume_from_object(bpy.data.objects["Derenzo"]).array)
    np.testing.assert_allclose(run.system.centers, ring_system.centers)
    assert run.settings["detector"] == "virtual"


def test_wrong_names_are_clear_errors_and_nothing_is_written(rendered, tmp_path):
    export = bpy.ops.mphdrr.export_dataset
    refused(export, "file", filepath="")
    for name, words in (("run.txt", "expected a name ending in"), ("nowhere/run.h5", "no such folder")):
        refused(export, words, filepath=str(tmp_path / name))
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    refused(export, "render the projections first", filepath=str(tmp_path / "run.h5"))
    assert list(tmp_path.iterdir()) == []
