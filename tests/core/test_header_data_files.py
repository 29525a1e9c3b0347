"""Headers name the file of their numbers: it lies in the header's folder or below it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused
from .test_header_numbers import FRAMES, INTERFILE, METAIMAGE, NRRD
from .test_hostile_hdf5 import needs_pipes

HEADERS = {
    "f.hdr": (INTERFILE, "f.sin", mph.read_counts),
    "f.mhd": (METAIMAGE, "f.raw", lambda path: mph.read_volume(path, "activity")),
    "f.nhdr": (NRRD, "f.raw", lambda path: mph.read_volume(path, "activity")),
}
VALUES = {name: FRAMES if name == "f.hdr" else FRAMES.transpose(2, 1, 0) for name in HEADERS}


@pytest.fixture(params=HEADERS)
def header(request, tmp_path):
    """Return the name of a header and a function that reads it from ``study/``, with another name of its numbers."""
    text, own, read = HEADERS[request.param]
    path = tmp_path / "study" / request.param
    path.parent.mkdir()

    def read_naming(name: str | Path):
        path.write_text(text.replace(own, str(name)))
        return np.asarray(getattr(found := read(path), "array", found))

    return request.param, read_naming


def numbers(path: Path) -> None:
    """Write the numbers of the headers."""
    path.parent.mkdir(exist_ok=True)
    FRAMES.tofile(path)


@pytest.mark.parametrize("name", ["x.v", "./x.v", "deep/x.v", "deep/../x.v", "a%20b.v", "list mode.v"])
def test_numbers_beside_the_header_or_below_it_are_read_under_any_name(header, tmp_path, name):
    numbers(tmp_path / "study" / "deep" / "placeholder")
    numbers(tmp_path / "study" / name)
    assert np.array_equal(header[1](name), VALUES[header[0]])
    assert np.array_equal(header[1](tmp_path / "study" / name), VALUES[header[0]])


@pytest.mark.parametrize("name", ["/home/other/x.v", r"C:\other\x.v", "../x.v", "out/x.v"])
def test_of_a_pair_that_was_moved_the_numbers_beside_the_header_are_read(header, tmp_path, name):
    numbers(tmp_path / "study" / "x.v")
    np.full_like(FRAMES, 7).tofile(tmp_path / "x.v")  # what the path leads to is never read
    assert np.array_equal(header[1](name), VALUES[header[0]])


@pytest.mark.parametrize("name", ["{}/x.v", "../x.v", "deep/../../x.v", "/dev/zero", "/etc/passwd"])
def test_numbers_outside_the_headers_folder_are_refused(header, tmp_path, name):
    numbers(tmp_path / "x.v")
    name = name.format(tmp_path)
    refused(lambda: header[1](name), header[0], name, "its numbers are read from the header's folder", Path(name).name)


def test_a_link_that_the_user_has_made_is_followed(header, tmp_path):
    """Data stores such as git-annex keep links in place of files; the header's own folder is that of its name."""
    numbers(tmp_path / "store" / "1234")
    (tmp_path / "study" / "x.v").symlink_to(tmp_path / "store" / "1234")
    assert np.array_equal(header[1]("x.v"), VALUES[header[0]])


@needs_pipes
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir])
def test_what_is_no_file_is_refused(header, tmp_path, make):
    make(tmp_path / "study" / "x.v")
    refused(lambda: header[1]("x.v"), header[0], "x.v", "expected a file")


def test_a_path_relative_to_the_working_folder_reads_the_same(header, tmp_path, monkeypatch):
    name, read_naming = header
    numbers(tmp_path / "study" / "x.v")
    read_naming("x.v")
    monkeypatch.chdir(tmp_path / "study")
    assert np.array_equal(getattr(found := HEADERS[name][2](name), "array", found), VALUES[name])


def test_meshes_read_no_other_file(tmp_path):
    """A .glb may name a file as its buffer, and an .obj one of materials."""
    import trimesh

    box = trimesh.creation.box()
    scene = trimesh.exchange.gltf.export_gltf(trimesh.Scene(box))
    for name, content in scene.items():
        (tmp_path / name).write_bytes(content)
    text = (tmp_path / "model.gltf").read_bytes()
    text += b" " * (-len(text) % 4)
    chunk = len(text).to_bytes(4, "little") + b"JSON" + text
    head = b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunk)).to_bytes(4, "little")
    (tmp_path / "m.glb").write_bytes(head + chunk)
    refused(lambda: mph.read_mesh(tmp_path / "m.glb"), "m.glb")
    (tmp_path / "m.obj").write_bytes(b"mtllib /dev/zero\n" + box.export(file_type="obj").encode())
    assert len(mph.read_mesh(tmp_path / "m.obj").faces) == 12
    shutil.rmtree(tmp_path)
