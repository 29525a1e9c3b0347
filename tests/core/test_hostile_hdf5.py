"""HDF5 that reads other files, claims what no memory holds, or never ends; and devices and pipes for files."""

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

from .conftest import refused
from .dicom_files import write_series

DATA = Path(__file__).with_name("data")
needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")

READERS: dict[str, Callable[[Path], Any]] = {
    "volume": mph.read_volume,
    "run": mph.read_run,
    "reconstruction": mph.read_reconstruction,
    "counts": mph.read_counts,
}
"""All that read HDF5, but event sets."""


def write_hostile(kind: str, file: h5py.File, secret: Path) -> None:
    """Give a file an "array" that leads to the `secret` file, or beyond memory."""
    if kind in ("virtual", "growing virtual"):  # the size of a growing one is that of the other file
        most = (2 if kind == "virtual" else None, 2, 2)
        end = 2 if kind == "virtual" else h5py.h5s.UNLIMITED
        layout = h5py.VirtualLayout((2, 2, 2), "f4", maxshape=most)
        layout[:end] = h5py.VirtualSource(str(secret), "array", (2, 2, 2), maxshape=most)[:end]
        file.create_virtual_dataset("array", layout)
    elif kind == "external":
        file.create_dataset("array", (2, 2, 2), "f4", external=[(str(secret), 0, 32)])
    elif kind == "link":
        file["array"] = h5py.ExternalLink(str(secret), "array")
    elif kind == "link through a group":
        file["far/away"] = h5py.ExternalLink(str(secret), "/")
        file["array"] = h5py.SoftLink("/far/away/array")
    elif kind == "petabytes":
        file.create_dataset("array", (2**20, 2**20, 2**10), "f4", chunks=(64, 64, 64))
    elif kind == "a chunk of terabytes":  # of which one small value is used
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((2**10, 2**10, 2**9))
        plist.set_deflate(1)
        space = h5py.h5s.create_simple((2, 2, 2), (h5py.h5s.UNLIMITED,) * 3)
        h5py.h5d.create(file.id, b"array", h5py.h5t.IEEE_F64LE, space, plist)
    else:
        file.create_dataset("array", (2, 2, 2), {"objects": h5py.vlen_dtype("f4"), "references": h5py.ref_dtype}[kind])


OTHER_FILES = ("external", "virtual", "growing virtual", "link")
HOSTILE = (*OTHER_FILES, "link through a group", "objects", "references", "petabytes")


def small_counts(folder: Path) -> Path:
    """Write counts of (2, 2, 2) and return their path."""
    with h5py.File(folder / "a.h5", "w") as file:
        file["array"] = np.ones((2, 2, 2))
    return folder / "a.h5"


@pytest.mark.parametrize(
    ("reader", "kind"),
    [
        pytest.param(reader, kind, marks=() if (i + j) % len(READERS) == 0 else pytest.mark.long)
        for i, reader in enumerate(READERS)
        for j, kind in enumerate(HOSTILE)
    ],
)
def test_what_leads_out_of_a_file_or_beyond_memory_is_refused(tmp_path, kind, reader):
    secret, path = tmp_path / "secret", tmp_path / "a.h5"
    with h5py.File(secret, "w") as file:
        file["array"] = np.full((2, 2, 2), 42, np.float32)
    with h5py.File(path, "w") as file:
        write_hostile(kind, file, secret)
        file["affine"] = np.eye(4)
        file.attrs["format"] = "mphDRR run"
    words = ("of memory",) if kind == "petabytes" and reader != "reconstruction" else ()
    refused(lambda: READERS[reader](path), str(path), *words)


@needs_pipes
@pytest.mark.parametrize("kind", OTHER_FILES)
def test_no_other_file_is_touched(tmp_path, kind):
    """A pipe would block whoever opened it."""
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        write_hostile(kind, file, tmp_path / "pipe")
    refused(lambda: mph.read_counts(path), str(path), "file")


def test_a_sealed_file_is_checked_as_well(tmp_path):
    """Whoever makes a file can seal it."""
    data = hdf5.pack("mphDRR volume", {}, lambda file: write_hostile("link", file, tmp_path / "secret"))
    (tmp_path / "a.h5").write_bytes(data)
    refused(lambda: mph.read_volume(tmp_path / "a.h5"), "a.h5", "link")


def test_a_small_array_in_huge_chunks_is_refused(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        try:
            write_hostile("a chunk of terabytes", file, tmp_path)
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
    path = small_counts(tmp_path)
    monkeypatch.setattr(hdf5, "_PROBE", body)
    monkeypatch.setattr(hdf5, "_PROBE_SECONDS", seconds)
    refused(lambda: mph.read_counts(path), "a.h5", words)


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
    monkeypatch.setattr(sys, "executable", program)
    assert mph.read_counts(small_counts(tmp_path)).shape == (2, 2, 2)


def test_the_look_at_a_file_runs_no_file_of_the_folder(tmp_path, monkeypatch):
    (tmp_path / "h5py.py").write_text("import os; os.abort()")
    small_counts(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert mph.read_counts("a.h5").shape == (2, 2, 2)


PLACES: dict[str, Callable[[Path], Any]] = {
    **{f"v{ending}": mph.read_volume for ending in (".nii", ".nii.gz", ".nrrd", ".mha", ".h5", ".npz", ".dcm", ".img")},
    **{f"r{ending}": mph.read_run for ending in (".h5", ".npz", ".pt")},
    **{f"c{ending}": mph.read_counts for ending in (".npy", ".h5", ".dcm", ".mhd", ".hdr")},
    "r.hdf5": mph.read_reconstruction,
    "w.xlsx": mph.read_system,
    "m.stl": mph.read_mesh,
    "g.json": mph.read_geometry,
    "t.toml": read_toml,
    "p.toml": mph.read_phantom,
}


@needs_pipes
@pytest.mark.parametrize("name", PLACES)
def test_pipes_and_devices_are_no_files(tmp_path, name):
    os.mkfifo(tmp_path / name)
    refused(lambda: PLACES[name](tmp_path / name), name, "neither a file nor a folder")
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/zero")
    refused(lambda: PLACES[name](tmp_path / name), name, "neither a file nor a folder")


HEADERS = {
    "a.mhd": "NDims = 3\nDimSize = 2 2 2\nElementType = MET_FLOAT\nElementDataFile = a.raw\n",
    "a.nhdr": "NRRD0004\ntype: float\ndimension: 3\nsizes: 2 2 2\nencoding: raw\nendian: little\ndata file: a.raw\n\n",
}


@needs_pipes
@pytest.mark.parametrize("name", [*HEADERS, "ct"])
def test_what_a_header_names_or_a_folder_holds_is_no_pipe_either(tmp_path, name):
    if name == "ct":
        write_series(mph.Volume(np.ones((3, 4, 5)), mph.Grid((3, 4, 5), np.eye(4)), "hu"), tmp_path / name)
    else:
        (tmp_path / name).write_text(HEADERS[name])
    os.mkfifo(tmp_path / ("ct/slice.dcm" if name == "ct" else "a.raw"))
    refused(lambda: mph.read_volume(tmp_path / name), str(tmp_path / name), "neither a file nor a folder")


@needs_pipes
def test_a_header_of_analyze_beside_a_pipe_is_refused(tmp_path):
    import nibabel

    nibabel.save(nibabel.Nifti1Pair(np.ones((2, 2, 2), np.float32), np.eye(4)), tmp_path / "a.img")
    for name in ("a.img", "a.hdr"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        os.mkfifo(tmp_path / name)
        for either in ("a.img", "a.hdr"):
            refused(lambda path=tmp_path / either: mph.read_volume(path), "neither a file nor a folder")
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes(whole)
