"""Volumes and runs in files: round trips, damage, and nothing half-written."""

import os
import sys

import h5py
import nibabel
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import hdf5
from mphdrr.core.files import replacing
from mphdrr.core.runs.mosaic import write_png

from .conftest import general_grid, needs_torch, refused


@pytest.fixture
def volume(rng):
    grid = general_grid(rng, (5, 6, 7))
    return mph.Volume(rng.normal(size=grid.shape), grid, "mu")


@pytest.fixture
def run(system, volume, rng):
    views = system.views(shape=(4, 6), detector="real", pitch=(0.5, 0.7))
    images = rng.uniform(size=(len(system), 4, 6)).astype(np.float32)
    settings = {"detector": "real", "angles": [1.5, 2], "phantom": None}
    return mph.ProjectionRun(
        images, system, views, volume, settings=settings, seed=7, workbook="scanner.xlsx", workbook_sha256="ab" * 32
    )


def test_nifti_with_a_damaged_header_is_refused_in_one_line(tmp_path, volume):
    mph.write_volume(volume, tmp_path / "v.nii")
    for place, damage in ((70, b"\xff\x7f"), (42, b"\x00\x80"), (123, b"\xff")):  # data type, size, units
        header = bytearray((tmp_path / "v.nii").read_bytes())
        header[place : place + len(damage)] = damage
        (tmp_path / "damaged.nii").write_bytes(header)
        refused(lambda: mph.read_volume(tmp_path / "damaged.nii"))


def test_files_of_unknown_kind_or_place_are_refused(tmp_path, volume):
    refused(lambda: mph.read_volume(tmp_path / "none.nii"), "no such file")
    refused(lambda: mph.write_volume(volume, tmp_path / "v.stl"), "expected a name ending in")
    refused(lambda: mph.write_volume(volume, tmp_path / "none" / "v.nii"), "no such folder")
    with pytest.raises(mph.InputError, match=r"not a file name|cannot be written"):
        mph.write_volume(volume, tmp_path / f"{'v' * 300}.nii")
    assert not list(tmp_path.iterdir())
    with open(tmp_path / "v.npz", "wb") as file:
        np.save(file, np.zeros((3, 3, 3)))
    refused(lambda: mph.read_volume(tmp_path / "v.npz"), "expected an npz archive")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = 1
    refused(lambda: mph.read_run(tmp_path / "a.h5"), "expected a file marked 'mphDRR run'")


def test_nifti_with_a_trailing_axis_of_one_is_a_volume_and_the_users_quantity_wins(tmp_path, volume):
    nibabel.save(nibabel.Nifti1Image(np.ones((3, 4, 5, 1), np.float32), np.eye(4)), tmp_path / "v.nii")
    assert mph.read_volume(tmp_path / "v.nii").array.shape == (3, 4, 5)
    mph.write_volume(volume, tmp_path / "v.nii.gz")
    assert mph.read_volume(tmp_path / "v.nii.gz", quantity="activity").quantity == "activity"


@pytest.mark.parametrize("suffix", [".h5", ".npz", pytest.param(".pt", marks=needs_torch)])
def test_runs_come_back_whole(tmp_path, run, suffix):
    mph.write_run(run, tmp_path / f"run{suffix}")
    back = mph.read_run(tmp_path / f"run{suffix}")
    assert np.array_equal(back.projections, run.projections)
    assert np.array_equal(back.volume.array, run.volume.array)
    assert back.volume.grid == run.volume.grid and back.volume.quantity == "mu"
    for name in ("numbers", *run.system.columns.fields):
        assert np.array_equal(getattr(back.system, name), getattr(run.system, name)), name
    assert np.array_equal(back.views.projection_matrices(), run.views.projection_matrices())
    assert back.settings == run.settings and back.versions == run.versions
    assert (back.seed, back.unit, back.workbook, back.workbook_sha256) == (7, "1/mm mm", "scanner.xlsx", "ab" * 32)


def test_pt_without_torch_says_so(tmp_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    refused(lambda: mph.write_run(run, tmp_path / "run.pt"), "torch is missing")
    assert not list(tmp_path.iterdir())


def test_hdf5_says_units_and_conventions_and_every_reader_opens_it(tmp_path, run):
    """The seal lies in the block that HDF5 leaves to users."""
    mph.write_run(run, tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5") as file:
        assert file.userblock_size == hdf5.HEADER and np.array_equal(file["projections"][()], run.projections)
        assert file["projections"].attrs["unit"] == "1/mm mm"
        assert file["geometry/collimator_length"].attrs["unit"] == "mm"
        assert "right-handed" in file.attrs["conventions"]
        assert file.attrs["seed"] == 7
        everything: list[str] = []
        file.visit(everything.append)
        assert all("unit" in file[name].attrs for name in everything if isinstance(file[name], h5py.Dataset))


def test_intrinsics_and_poses_reproject_points(run, rng):
    points = np.c_[rng.uniform(-50, 50, (20, 3)), np.ones(20)]
    local = np.linalg.inv(run.system.poses()) @ points.T
    by_intrinsics = run.intrinsics() @ local[:, :3]
    by_matrix = run.views.projection_matrices() @ points.T
    assert np.allclose(by_intrinsics[:, :2] / by_intrinsics[:, 2:], by_matrix[:, :2] / by_matrix[:, 2:])
    assert np.allclose(run.intrinsics()[:, 2], [0, 0, 1])


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half of the new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_goes_on_leading_to_the_written_file(tmp_path):
    path, link = tmp_path / "folder" / "whole.bin", tmp_path / "link.bin"
    path.parent.mkdir()
    path.write_bytes(b"old")
    try:
        link.symlink_to(path)
    except OSError as error:
        pytest.skip(f"no links here ({error})")
    with replacing(link) as temporary:
        temporary.write_bytes(b"new")
    assert link.is_symlink() and path.read_bytes() == b"new"
    assert [p.name for p in path.parent.iterdir()] == ["whole.bin"]


@pytest.mark.skipif(
    os.name == "nt" or (hasattr(os, "geteuid") and os.geteuid() == 0), reason="root may write everywhere"
)
def test_an_unwritable_folder_is_refused(tmp_path, run):
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    refused(lambda: mph.write_run(run, folder / "run.h5"), "cannot be written")


def test_pictures_are_as_the_pinhole_sees_them(tmp_path):
    images = np.zeros((3, 4, 5), np.float32)
    images[1, 3, 0] = 1  # top row (+v), first column (-u: to the right as seen from the pinhole)
    sheet = mph.mosaic(images, columns=2)
    assert sheet.shape == (8, 10) and sheet[0, 9] == sheet.sum() == 1
    write_png(sheet, tmp_path / "m.png")
    from PIL import Image

    assert np.array_equal(np.asarray(Image.open(tmp_path / "m.png")), (sheet * 255).astype(np.uint8))
