"""Mesh files whose text or JSON says more than a loader reads: read right, or refused in one line.

https://github.com/mikedh/trimesh/issues/2364 (relative indices), https://github.com/rdeioris/glTFRuntime/issues/57
(quantized glTF); glTF 2.0, 3.6.2 and 3.12; the OBJ text of Wavefront.
"""

from __future__ import annotations

import itertools
import json
import struct

import numpy as np
import pytest
import trimesh

import mphdrr.core as mph

from ..core.conftest import refused

CORNERS = np.array(list(itertools.product((0.0, 10.0), repeat=3)))
FACES = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))


def vertices(shift: float = 0.0) -> list[str]:
    return ["v {} {} {}".format(*(corner + np.array([shift, 0.0, 0.0]))) for corner in CORNERS]


def faces(text: str, shift: int = 0) -> list[str]:
    """Return the lines of a cube's faces; `text` has {} for the indices."""
    return [text.format(" ".join(str(i + shift) for i in face)) for face in FACES]


OBJ = {
    "comments": [*vertices(), *faces("f {} # side")],
    "tight comments": [*vertices(), *faces("f {}#1")],
    "comments behind vertices": [*(f"{line} # {k}" for k, line in enumerate(vertices())), *faces("f {}")],
    "relative indices": [*vertices(), *faces("f {}", -9)],
    "groups": ["g a", *vertices(), *faces("f {}"), "g b", *vertices(20), *faces("f {}", -9)],
    "vertices first": [*vertices(), *vertices(20), "o a", *faces("f {}"), "o b", *faces("f {} #", -9)],
}


@pytest.mark.parametrize("name", OBJ)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_obj_holds_its_cubes(tmp_path, name, end):
    path = tmp_path / "cubes.obj"
    path.write_bytes(end.join(["# two", *OBJ[name], ""]).encode())
    mesh = mph.read_mesh(path)
    n_cubes = sum(line.startswith("v") for line in OBJ[name]) // 8
    assert mesh.volume == pytest.approx(1000.0 * n_cubes) and len(mesh.faces) == 12 * n_cubes
    assert np.ptp(mesh.vertices[mesh.faces.ravel()], axis=0).tolist() == [10.0 if n_cubes == 1 else 30.0, 10.0, 10.0]


@pytest.mark.parametrize("between", [[], ["o b"], ["usemtl b", "usemtl a"]])
def test_relative_indices_before_further_vertices_are_refused(tmp_path, between):
    path = tmp_path / "cubes.obj"
    lines = ["o a", *vertices(), *faces("f {}", -9), *between, *vertices(20), *faces("f {}", -9)]
    path.write_text("\n".join(lines), encoding="utf-8")
    refused(lambda: mph.read_mesh(path), "relative indices stand before further vertices")


def glb(path, change) -> None:
    """Write a cube as .glb, its JSON changed by `change`."""
    content = trimesh.creation.box((0.01, 0.01, 0.01)).export(file_type="glb")
    length = int.from_bytes(content[12:16], "little")
    header = json.loads(content[20 : 20 + length])
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    path.write_bytes(
        struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest
    )


def _position(header) -> dict:
    return header["accessors"][header["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]


GLB = {
    "it requires KHR_draco_mesh_compression": lambda h: h.update(extensionsRequired=["KHR_draco_mesh_compression"]),
    "it requires EXT_meshopt_compression": lambda h: h.update(extensionsRequired=["KHR_xmp", "EXT_meshopt_compression"]),
    "its positions are quantized": lambda h: _position(h).update(componentType=5122, normalized=True),
    "it has sparse accessors": lambda h: _position(h).update(sparse={"count": 1}),
    "it has morph targets with weights": lambda h: h["meshes"][0].update(weights=[0.0, 0.5]),
    "its skin moves it": lambda h: h["nodes"][-1].update(skin=0),
}  # fmt: skip


@pytest.mark.parametrize("words", GLB)
def test_a_glb_with_another_shape_is_refused(tmp_path, words):
    path = tmp_path / "cube.glb"
    glb(path, lambda header: header.update(extensionsRequired=["KHR_materials_unlit"]))
    assert mph.read_mesh(path).volume == pytest.approx(1000.0, rel=1e-5)
    glb(path, GLB[words])
    refused(lambda: mph.read_mesh(path), words, "as .ply")


@pytest.mark.parametrize("shape", ["box", "icosphere", "cylinder"])
def test_an_stl_that_is_cut_or_goes_on_says_so(tmp_path, shape):
    options = {"box": {}, "icosphere": {"subdivisions": 1}, "cylinder": {"radius": 2.0, "height": 5.0}}[shape]
    solid = getattr(trimesh.creation, shape)(**options)
    path = tmp_path / "solid.stl"
    content = solid.export(file_type="stl")
    path.write_bytes(content)
    assert mph.read_mesh(path).volume == pytest.approx(solid.volume, rel=1e-6)
    for wrong in (content[:-50], content[:-1], content + b"\0", content + b"end of file"):
        path.write_bytes(wrong)
        refused(lambda: mph.read_mesh(path), f"expected {len(content)} bytes", f"found {len(wrong)}")
    text = solid.export(file_type="stl_ascii").encode()
    path.write_bytes(text)
    assert mph.read_mesh(path).volume == pytest.approx(solid.volume, rel=1e-5)
    path.write_bytes(text[: 2 * len(text) // 3])
    refused(lambda: mph.read_mesh(path), "it is cut short")
