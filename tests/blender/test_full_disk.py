"""A disk that is full: OpenVDB, Blender's own files and rendered figures end in one line, too."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli.scene import new_scene, save_scene
from mphdrr.addon.volumes.vdb import read_vdb, write_vdb

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
