"""A .blend and its folder stay together: Save As, moves, names, Collect Files."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import storage
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.runs.files import read_run
from mphdrr.core.volumes.volume import Volume

SMALL = {"width": 12, "height": 10}


@pytest.fixture
def study(scene, small_workbook, tmp_path) -> Path:
    """A saved scene with a scanner, a beating volume, a run and a reconstruction; its workbook lies elsewhere."""
    tables = tmp_path / "tables"
    tables.mkdir()
    bpy.ops.mphdrr.import_geometry(filepath=shutil.copy(small_workbook, tables))
    bpy.ops.mphdrr.add_derenzo(voxels=16)
    bpy.ops.mphdrr.render_projections(**SMALL)
    bpy.ops.mphdrr.reconstruct(method="CGLS", voxels=12, iterations=1)
    grid = Grid.centered(4, 1.0)
    volumes.add_volume([Volume(np.full((4, 4, 4), k, np.float32), grid, "mu") for k in (1, 2)], "Beats")
    (tmp_path / "a").mkdir()
    path = tmp_path / "a" / "study.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def contents(folder: Path) -> dict[str, str]:
    """The files below a folder, with their checksums."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def held() -> dict[str, np.ndarray]:
    """All voxels and counts that the scene's files hold."""
    scene = bpy.context.scene
    found = {
        f"{item.name} {k}": volumes.reader(item, path)().array
        for item in volumes.volume_objects(scene)
        for k, path in enumerate(storage.state_files(item.data))
    }
    found |= {run.name: read_run(storage.absolute(run.file)).projections for run in scene.mphdrr_projections.runs}
    return found


def is_whole(top: Path, expected: dict[str, np.ndarray]) -> None:
    """Whether the scene's files are below a folder, and hold what they did."""
    assert storage.missing_volumes() == []
    assert all(item.data.grids.load() for item in volumes.volume_objects(bpy.context.scene))
    named = [storage.absolute(getattr(owner, name)).resolve() for owner, name in storage.file_references()]
    outside = [path for path in named if not path.is_relative_to(top) and path.is_file()]
    assert [path for path in outside if path.suffix != ".xlsx"] == []
    now = held()
    assert now.keys() == expected.keys() and all(np.array_equal(now[name], expected[name]) for name in now)
    assert runs.shown_run(bpy.context.scene) is not None


def test_save_as_makes_a_pair_of_its_own_that_opens_elsewhere(study, tmp_path, capfd):
    expected, before = held(), contents(study.parent)
    assert len(expected) == 5, "a phantom, two states, a reconstruction, a run"
    new = tmp_path / "b" / "other.blend"
    new.parent.mkdir()
    capfd.readouterr()
    bpy.ops.wm.save_as_mainfile(filepath=str(new))
    is_whole(new.parent, expected)
    said = capfd.readouterr().out
    assert "mphDRR: Copied 6 files (" in said and ") into other_mphdrr; 1 file (" in said
    assert "elsewhere: Collect Files copies them" in said
    assert contents(study.parent) == before, "the old pair"
    shutil.move(new.parent, tmp_path / "c")
    shutil.rmtree(study.parent)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "c" / "other.blend"))
    is_whole(tmp_path / "c", expected)
    # Renamed, both.
    (tmp_path / "c" / "other.blend").rename(tmp_path / "c" / "last.blend")
    (tmp_path / "c" / "other_mphdrr").rename(tmp_path / "c" / "last_mphdrr")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "c" / "last.blend"))
    is_whole(tmp_path / "c" / "last_mphdrr", expected)


@pytest.mark.parametrize("remapped", [True, False])
def test_a_copy_is_whole_and_leaves_the_session_as_it_was(study, tmp_path, remapped):
    expected, paths = held(), [getattr(owner, name) for owner, name in storage.file_references()]
    copy = tmp_path / "b" / "copy.blend"
    copy.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True, relative_remap=remapped)
    assert [getattr(owner, name) for owner, name in storage.file_references()] == paths
    is_whole(study.parent, expected)
    bpy.ops.wm.open_mainfile(filepath=str(copy))
    is_whole(copy.parent, expected)


def test_files_can_be_shared_and_are_when_they_are_large(study, tmp_path, monkeypatch, capfd):
    expected = held()
    (tmp_path / "b").mkdir()
    capfd.readouterr()
    monkeypatch.setattr(storage, "copies", False)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "b.blend"))
    assert "mphDRR: Shares 6 files (" in capfd.readouterr().out and not (tmp_path / "b" / "b_mphdrr").exists()
    is_whole(study.parent, expected)
    monkeypatch.setattr(storage, "copies", True)
    monkeypatch.setattr(storage, "_is_too_large", lambda path, size, target: path.suffix == ".h5")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "c.blend"))
    assert "Copied 5 files (" in (said := capfd.readouterr().out) and "shares 1 file (" in said
    assert (
        storage.absolute(bpy.context.scene.mphdrr_projections.run_file).resolve().parent
        == study.parent / "study_mphdrr"
    )
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "c.blend"))
    is_whole(tmp_path, expected)


def test_collect_files_brings_workbook_pictures_and_what_is_shared(study, tmp_path, monkeypatch, capfd):
    expected, scene = held(), bpy.context.scene
    picture = bpy.data.images.new("photo", 4, 4)
    picture.filepath_raw, picture.file_format = str(tmp_path / "tables" / "photo.png"), "PNG"
    picture.save()
    photo = bpy.data.images.load(str(tmp_path / "tables" / "photo.png"))
    scene.camera.data.background_images.new().image = photo
    np.save(tmp_path / "tables" / "flood.npy", np.ones((16, 10, 12)))
    scene.mphdrr_projections.efficiency_of_modules = str(tmp_path / "tables" / "flood.npy")
    scene.mphdrr_reconstruction.method_file = str(tmp_path / "tables" / "net.pt")  # which is not there
    scene.mphdrr_projections.time_of_modules = "10, 20"
    bpy.context.scene.mphdrr_events.folder = "//not-made-yet-events"
    other = bpy.data.scenes.new("Other")
    other.mphdrr_projections.efficiency_of_modules = "1, 0.5"
    monkeypatch.setattr(storage, "copies", False)
    (tmp_path / "b").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "b.blend"))
    (tmp_path / "b" / "b_mphdrr").mkdir()
    (tmp_path / "b" / "b_mphdrr" / "flood.npy").write_text("another")
    capfd.readouterr()
    assert bpy.ops.mphdrr.collect_files() == {"FINISHED"}
    said = capfd.readouterr().out
    assert "Copied 9 files (" in said and "missing: net.pt\n" in said and "stay" not in said
    scene.mphdrr_reconstruction.method_file = ""
    bpy.ops.wm.save_mainfile()
    shutil.move(tmp_path / "b", tmp_path / "c")
    shutil.rmtree(tmp_path / "tables")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "c" / "b.blend"))
    home, scene = tmp_path / "c" / "b_mphdrr", bpy.context.scene
    is_whole(home, expected)
    collection = scanner.active_scanner(scene)
    assert (
        storage.absolute(collection.mphdrr_scanner.workbook) == scanner.source(collection).path == home / "small.xlsx"
    )
    assert bpy.data.scenes["Other"].mphdrr_projections.efficiency_of_modules == "1, 0.5"
    assert scene.mphdrr_events.folder == "//../a/not-made-yet-events"
    assert storage.absolute(scene.mphdrr_projections.efficiency_of_modules).name == "flood-2.npy"
    assert storage.absolute(bpy.data.images["photo.png"].filepath) == home / "photo.png"
    assert "Copied" not in capfd.readouterr().out
    assert bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "out.xlsx")) == {"FINISHED"}


def test_a_full_disk_leaves_the_files_where_they_are(study, tmp_path, monkeypatch, capfd):
    def full(source: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    expected = held()
    monkeypatch.setattr(storage.os, "link", full)
    monkeypatch.setattr(storage.shutil, "copyfile", full)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    assert "No space left on device" in capfd.readouterr().out
    is_whole(study.parent, expected)
