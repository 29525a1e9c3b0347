"""A .blend and its folder stay together: Save As, moves, names, Collect Files, crashes and full disks."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon import recovery
from mphdrr.addon.blender import jobs, storage
from mphdrr.addon.cli.scene import new_scene, save_scene
from mphdrr.addon.phantoms import phantom_properties, phantoms
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.addon.volumes.vdb import read_vdb, write_vdb
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.runs.files import read_run
from mphdrr.core.volumes.volume import Volume

from .conftest import refused, update

SMALL = {"width": 12, "height": 10}


@pytest.fixture
def study(scene, small_workbook, tmp_path) -> Path:
    """Save a scene with a scanner, a beating volume, a run and a reconstruction; its workbook lies elsewhere."""
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
    """Return the files below a folder, with their checksums."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def held() -> dict[str, np.ndarray]:
    """Return all voxels and counts that the scene's files hold."""
    scene = bpy.context.scene
    found = {
        f"{item.name} {k}": volumes.reader(item, path)().array
        for item in volumes.volume_objects(scene)
        for k, path in enumerate(storage.state_files(item.data))
    }
    found |= {run.name: read_run(storage.absolute(run.file)).projections for run in scene.mphdrr_projections.runs}
    return found


def is_whole(top: Path, expected: dict[str, np.ndarray]) -> None:
    """Check that the scene's files are below a folder, and hold what they did."""
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
    run_file = storage.absolute(bpy.context.scene.mphdrr_projections.run_file)
    assert run_file.resolve().parent == study.parent / "study_mphdrr"
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
    collection, tables = scanner.active_scanner(scene), home / "small.xlsx"
    assert storage.absolute(collection.mphdrr_scanner.workbook) == scanner.source(collection).path == tables
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


TANK = {"rod_diameters": (0,) * 6, "sphere_diameters": (30, 0, 0, 0, 0, 0)}  # little to paint


@pytest.fixture
def crashed(scene, small_workbook, tmp_path, capsys):
    """Open a scene with volumes of every origin again after their files have gone; return their voxels by name."""
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    job = phantoms.add_phantom_job(phantom_properties.plain_settings("jaszczak", voxels=24, **TANK), "Tank", None, True)
    jobs.run(job)
    bpy.data.objects["Tank"].location = (3.0, 4.0, 5.0)
    bpy.ops.mphdrr.add_map(quantity="modules", voxels=6, side=90, within_roi=False)
    update()
    made = {item.name: volumes.volume_from_object(item) for item in volumes.volume_objects(scene)}
    volumes.add_volume(Volume(np.ones((4, 4, 4)), Grid.centered(4, 1.0), "hu"), "CT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "study.blend"))
    shutil.rmtree(tmp_path / "study_mphdrr")
    storage._cached_size.cache_clear()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "study.blend"))
    said = capsys.readouterr().out
    assert "Modules map, Tank are missing: press Make Again" in said
    assert "CT are missing: Find Missing Volume Files, or import again" in said
    return made


def test_one_update_gives_one_grid(crashed):
    item = bpy.data.objects["Tank"]
    bpy.context.view_layer.objects.active = item
    assert not item.data.grids.load()
    assert bpy.ops.mphdrr.update_phantom() == {"FINISHED"}
    assert item.data.grids.load() and [grid.name for grid in item.data.grids] == ["activity"]
    assert np.array_equal(volumes.volume_from_object(item).array, crashed["Tank"].array)


def test_all_with_a_recipe_are_made_again_where_they_were(crashed, capsys):
    storage._cached_size.cache_clear()
    assert bpy.ops.mphdrr.remake_volumes() == {"FINISHED"}
    assert "CT: find the voxel files" in capsys.readouterr().out
    storage._cached_size.cache_clear()
    again, others = recovery.missing_volumes(bpy.context.scene)
    assert again == [] and [item.name for item in others] == ["CT"]
    assert set(crashed) == {"Tank", "Tank mu", "Modules map"}
    for name, volume in crashed.items():
        back = volumes.volume_from_object(bpy.data.objects[name])
        assert np.array_equal(back.array, volume.array)
        np.testing.assert_allclose(back.grid.affine, volume.grid.affine, atol=1e-6)
    refused(bpy.ops.mphdrr.remake_volumes, "No phantom or map misses its file")


SIZE = 64 << 10


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    with contextlib.suppress(OSError):
        command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "none", str(folder)]
        if subprocess.run(command, capture_output=True).returncode == 0:
            yield folder
            subprocess.run(["umount", "--lazy", str(folder)], check=True)
            return
    pytest.skip("no small disk can be mounted here")


@pytest.mark.parametrize("side", [26, 40])
def test_voxels_on_a_full_disk_are_one_line_and_leave_the_old_file(disk, side):
    """OpenVDB itself says nothing, and leaves a file that reads as other numbers."""
    rng = np.random.default_rng(side)
    grid = mph.Grid((side,) * 3, np.eye(4))
    small = mph.Volume(np.ones((2, 2, 2), np.float32), mph.Grid((2, 2, 2), np.eye(4)), "mu")
    path = disk / "a.vdb"
    write_vdb(small, path)
    with pytest.raises(mph.InputError, match="cannot be written"):
        write_vdb(mph.Volume(rng.random(grid.shape, np.float32), grid, "mu"), path)
    assert list(disk.iterdir()) == [path]
    assert np.array_equal(read_vdb(path).array, small.array)


def test_a_blend_on_a_full_disk_is_one_line(disk):
    new_scene()
    mesh = bpy.data.meshes.new("points")  # more than the disk holds, and not to be compressed
    mesh.from_pydata(np.random.default_rng(0).random((20_000, 3)), [], [])
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("points", mesh))
    with pytest.raises(mph.InputError, match="cannot be written") as error:
        save_scene(disk / "a.blend")
    assert "\n" not in str(error.value)
    assert list(disk.iterdir()) == []


def test_a_figure_on_a_full_disk_is_one_line_and_status_1(disk, small_workbook, capsys):
    from mphdrr.__main__ import main

    (disk / "other").write_bytes(bytes(SIZE))
    words = ["figure", "scanner", str(small_workbook), "--size", "120x120", "--samples", "1", "-o", str(disk / "a.png")]
    assert main(words) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert [path.name for path in disk.iterdir()] == ["other"]
