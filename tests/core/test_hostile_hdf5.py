"""HDF5 that reads other files, claims what no memory holds, or never ends; and devices and pipes for files."""

from __future__ import annotations

import gzip
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import hdf5
from mphdrr.core.recipes.toml import read_toml
from mphdrr.core.volumes.meshes.mesh import read_mesh

from .conftest import refused
from .dicom_files import write_series

DATA = Path(__file__).with_name("data")

READERS: dict[str, Callable[[Path], Any]] = {
    "volume": mph.read_volume,
    "run": mph.read_run,
    "reconstruction": mph.read_reconstruction,
    "counts": mph.read_counts,
}
"""All that read HDF5, but event sets."""


def external(file: h5py.File, secret: Path) -> None:
    file.create_dataset("array", (2, 2, 2), "f4", external=[(str(secret), 0, 32)])


def virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((2, 2, 2), "f4")
    layout[:] = h5py.VirtualSource(str(secret), "array", (2, 2, 2))
    file.create_virtual_dataset("array", layout)


def growing_virtual(file: h5py.File, secret: Path) -> None:
    """Whose size is that of the other file."""
    layout = h5py.VirtualLayout((2, 2, 2), "f4", maxshape=(None, 2, 2))
    source = h5py.VirtualSource(str(secret), "array", (2, 2, 2), maxshape=(None, 2, 2))
    layout[0 : h5py.h5s.UNLIMITED, :, :] = source[0 : h5py.h5s.UNLIMITED, :, :]
    file.create_virtual_dataset("array", layout)


def linked(file: h5py.File, secret: Path) -> None:
    file["array"] = h5py.ExternalLink(str(secret), "array")


def linked_through_a_group(file: h5py.File, secret: Path) -> None:
    file["far/away"] = h5py.ExternalLink(str(secret), "/")
    file["array"] = h5py.SoftLink("/far/away/array")


def objects(file: h5py.File, secret: Path) -> None:
    file.create_dataset("array", (2, 2, 2), h5py.vlen_dtype(np.float32))


def references(file: h5py.File, secret: Path) -> None:
    file.create_dataset("array", (2, 2, 2), h5py.ref_dtype)


def petabytes(file: h5py.File, secret: Path) -> None:
    file.create_dataset("array", (2**20, 2**20, 2**10), "f4", chunks=(64, 64, 64))


def a_chunk_of_terabytes(file: h5py.File, secret: Path) -> None:
    """Of which one small value is used."""
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk((2**10, 2**10, 2**9))
    plist.set_deflate(1)
    space = h5py.h5s.create_simple((2, 2, 2), (h5py.h5s.UNLIMITED,) * 3)
    h5py.h5d.create(file.id, b"array", h5py.h5t.IEEE_F64LE, space, plist)


HOSTILE = (external, virtual, growing_virtual, linked, linked_through_a_group, objects, references, petabytes)


@pytest.mark.parametrize(
    ("reader", "make"),
    [
        pytest.param(reader, make, marks=() if (i + j) % len(READERS) == 0 else pytest.mark.long)
        for i, reader in enumerate(READERS)
        for j, make in enumerate(HOSTILE)
    ],
)
def test_what_leads_out_of_a_file_or_beyond_memory_is_refused(tmp_path, make, reader):
    secret = tmp_path / "secret"
    with h5py.File(secret, "w") as file:
        file["array"] = np.full((2, 2, 2), 42, np.float32)
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        make(file, secret)
        file["affine"] = np.eye(4)
        file.attrs["format"] = "mphDRR run"
    words = ("of memory",) if make is petabytes and reader != "reconstruction" else ()
    refused(lambda: READERS[reader](path), str(path), *words)


@pytest.mark.parametrize("make", [external, virtual, growing_virtual, linked], ids=lambda make: make.__name__)
def test_no_other_file_is_touched(tmp_path, make):
    """A pipe would block whoever opened it."""
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes on this system")
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        make(file, tmp_path / "pipe")
    refused(lambda: mph.read_counts(path), str(path), "file")


def test_a_sealed_file_is_checked_as_well(tmp_path):
    """Whoever makes a file can seal it."""
    data = hdf5.pack("mphDRR volume", {}, lambda file: linked(file, tmp_path / "secret"))
    (tmp_path / "a.h5").write_bytes(data)
    refused(lambda: mph.read_volume(tmp_path / "a.h5"), "a.h5", "link")


def test_a_small_array_in_huge_chunks_is_refused(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        try:
            a_chunk_of_terabytes(file, tmp_path)
        except ValueError:
            pytest.skip("this HDF5 makes no such chunks")
    monkeypatch.setattr("mphdrr.core.memory.available", lambda: 2**30)
    refused(lambda: mph.read_counts(tmp_path / "a.h5"), "a.h5", "of memory")


def test_links_within_a_file_are_followed(tmp_path, rng):
    counts = rng.integers(0, 9, (3, 4, 5))
    with h5py.File(tmp_path / "nexus.h5", "w") as file:
        file["entry/instrument/data"] = counts
        file["entry/data"] = h5py.SoftLink("/entry/instrument/data")
        file["entry/again"] = file["entry/instrument"]
        file["entry/nowhere"] = h5py.SoftLink("/none")
        file["entry/instrument/up"] = file["entry"]
        file["title"] = "a text"
    for name in ("entry/instrument/data", "/entry/data", "entry/again/data"):
        assert np.array_equal(mph.read_counts(tmp_path / "nexus.h5", dataset=name), counts)


@pytest.mark.parametrize(
    ("body", "seconds", "words"),
    [("while True: pass", 0.5, "no end"), ("import os; os.abort()", 60, "crashes")],
)
def test_what_hangs_or_crashes_hdf5_is_one_line(tmp_path, monkeypatch, body, seconds, words):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["array"] = np.ones((2, 2, 2))
    monkeypatch.setattr(hdf5, "_PROBE", body)
    monkeypatch.setattr(hdf5, "_PROBE_SECONDS", seconds)
    refused(lambda: mph.read_counts(tmp_path / "a.h5"), "a.h5", words)


@pytest.mark.parametrize("name", ["endless", "crashing"])
def test_a_file_that_hdf5_does_not_survive_is_one_line(tmp_path, monkeypatch, name):
    """Each has one wrong bit. Another HDF5 may refuse it, or read it."""
    (tmp_path / "a.h5").write_bytes(gzip.decompress((DATA / f"{name}.h5.gz").read_bytes()))
    monkeypatch.setattr(hdf5, "_PROBE_SECONDS", 1)
    try:
        mph.read_counts(tmp_path / "a.h5", dataset="array")
        pytest.skip("this HDF5 reads it")
    except mph.InputError as error:
        assert "a.h5" in str(error) and "damaged" in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("program", ["", None, "/usr/bin/blender", "/nowhere/python3"])
def test_where_no_python_can_be_started_files_are_read_as_they_are(tmp_path, monkeypatch, program):
    """Such as in a program that has Python in it: to start it again would open its window."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["array"] = np.ones((2, 2, 2))
    monkeypatch.setattr(sys, "executable", program)
    assert mph.read_counts(tmp_path / "a.h5").shape == (2, 2, 2)


def test_the_look_at_a_file_runs_no_file_of_the_folder(tmp_path, monkeypatch):
    (tmp_path / "h5py.py").write_text("import os; os.abort()")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["array"] = np.ones((2, 2, 2))
    monkeypatch.chdir(tmp_path)
    assert mph.read_counts("a.h5").shape == (2, 2, 2)


PLACES: dict[str, Callable[[Path], Any]] = {
    **{f"v{ending}": mph.read_volume for ending in (".nii", ".nii.gz", ".nrrd", ".mha", ".h5", ".npz", ".dcm", ".img")},
    **{f"r{ending}": mph.read_run for ending in (".h5", ".npz", ".pt")},
    **{f"c{ending}": mph.read_counts for ending in (".npy", ".h5", ".dcm", ".mhd", ".hdr")},
    "r.hdf5": mph.read_reconstruction,
    "w.xlsx": mph.read_system,
    "m.stl": read_mesh,
    "g.json": mph.read_geometry,
    "t.toml": read_toml,
    "p.toml": mph.read_phantom,
}


@pytest.mark.parametrize("name", PLACES)
def test_pipes_and_devices_are_no_files(tmp_path, name):
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes on this system")
    os.mkfifo(tmp_path / name)
    refused(lambda: PLACES[name](tmp_path / name), name, "neither a file nor a folder")
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/zero")
    refused(lambda: PLACES[name](tmp_path / name), name, "neither a file nor a folder")


def _beside(header: str, text: str, data: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / header).write_text(text)
        os.mkfifo(folder / data)
        return folder / header

    return make


def _slices(folder: Path) -> Path:
    volume = mph.Volume(np.ones((3, 4, 5)), mph.Grid((3, 4, 5), np.eye(4)), "hu")
    write_series(volume, folder / "ct")
    os.mkfifo(folder / "ct" / "slice.dcm")
    return folder / "ct"


HEADERS = {
    "MetaImage": _beside(
        "a.mhd", "NDims = 3\nDimSize = 2 2 2\nElementType = MET_FLOAT\nElementDataFile = a.raw\n", "a.raw"
    ),
    "NRRD": _beside(
        "a.nhdr", "NRRD0004\ntype: float\ndimension: 3\nsizes: 2 2 2\nencoding: raw\nendian: little\ndata file: a.raw\n\n",
        "a.raw",
    ),
    "series": _slices,
}  # fmt: skip


@pytest.mark.parametrize("kind", HEADERS)
def test_what_a_header_names_is_no_pipe_either(tmp_path, kind):
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes on this system")
    path = HEADERS[kind](tmp_path)
    refused(lambda: mph.read_volume(path), str(path), "neither a file nor a folder")


def test_a_header_of_analyze_beside_a_pipe_is_refused(tmp_path):
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes on this system")
    import nibabel

    nibabel.save(nibabel.Nifti1Pair(np.ones((2, 2, 2), np.float32), np.eye(4)), tmp_path / "a.img")
    for name in ("a.img", "a.hdr"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        os.mkfifo(tmp_path / name)
        for given in ("a.img", "a.hdr"):
            refused(lambda given=given: mph.read_volume(tmp_path / given), "neither a file nor a folder")
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes(whole)
