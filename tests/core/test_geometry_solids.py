"""Solids as files: other programs read the geometry with names, closed surfaces and the right positions."""

import json
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.collimator import Construction

trimesh = pytest.importorskip("trimesh")

PLATE, WALL = 3.0, 1.5
MM = 1e-4  # float32 holds lengths of a scanner to about 3e-5 mm


def read_glb(path) -> dict:
    """Read by the glTF 2.0 specification alone: meshes as its nodes place them, converted back from metres and +y up."""
    document, buffer = glb_chunks(path)
    meshes = {}

    def numbers(accessor: dict, kind: str, columns: int) -> np.ndarray:
        view = document["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(buffer, kind, accessor["count"] * columns, start).reshape(-1, 3)

    def visit(node: dict, pose: np.ndarray) -> None:
        pose = pose @ np.reshape(node.get("matrix", np.eye(4)), (4, 4)).T
        for child in node.get("children", []):
            visit(document["nodes"][child], pose)
        if "mesh" not in node:
            return
        mesh = document["meshes"][node["mesh"]]
        (primitive,) = mesh["primitives"]
        assert mesh["name"] == node["name"] and primitive.get("mode", 4) == 4
        material = document["materials"][primitive["material"]]["name"]
        assert node["name"].endswith(material)
        positions, indices = (
            document["accessors"][i] for i in (primitive["attributes"]["POSITION"], primitive["indices"])
        )
        assert (positions["componentType"], positions["type"], indices["componentType"]) == (5126, "VEC3", 5125)
        stored = numbers(positions, "<f4", 3).astype(float)
        x, y, z = (stored @ pose[:3, :3].T + pose[:3, 3]).T * 1000
        meshes[node["name"]] = trimesh.Trimesh(np.column_stack([x, -z, y]), numbers(indices, "<u4", 1), process=False)
        assert np.allclose(meshes[node["name"]].vertices, stored, atol=MM)  # stored in mm

    for root in document["scenes"][document["scene"]]["nodes"]:
        visit(document["nodes"][root], np.eye(4))
    return meshes


def glb_chunks(path) -> tuple[dict, bytes]:
    """Return the JSON and the binary chunk."""
    data = path.read_bytes()
    magic, version, length = data[:4], *np.frombuffer(data[4:12], "<u4")
    assert (magic, version, length) == (b"glTF", 2, len(data))
    start, chunks = 12, []
    while start < length:
        (size,) = np.frombuffer(data[start : start + 4], "<u4")
        assert size % 4 == 0
        chunks.append((data[start + 4 : start + 8], data[start + 8 : start + 8 + int(size)]))
        start += 8 + int(size)
    (json_kind, text), (binary_kind, buffer) = chunks
    assert (json_kind, binary_kind, start) == (b"JSON", b"BIN\0", length)
    return json.loads(text), buffer


def read_3mf(path) -> dict:
    pytest.importorskip("lxml", reason="trimesh reads 3MF with lxml")
    pytest.importorskip("networkx", reason="trimesh reads 3MF with networkx")
    scene = trimesh.load(path)
    assert scene.units == "millimeter"
    return dict(scene.geometry)


def read_3mf_as_xml(path) -> dict:
    """Read by the 3MF core specification alone."""
    core = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    with zipfile.ZipFile(path) as package:
        relationship = ElementTree.fromstring(package.read("_rels/.rels"))[0]
        types = ElementTree.fromstring(package.read("[Content_Types].xml"))
        assert {t.get("Extension") for t in types} == {"rels", "model"}
        model = ElementTree.fromstring(package.read(relationship.get("Target").lstrip("/")))
    assert model.tag == f"{core}model" and model.get("unit") == "millimeter"
    colors = [base.get("displaycolor") for base in model.iter(f"{core}base")]
    assert len(set(colors)) == 2
    objects = {o.get("id"): o for o in model.iter(f"{core}object")}
    meshes = {}
    for item in model.iter(f"{core}item"):
        part = objects.pop(item.get("objectid"))
        vertices = [[float(v.get(c)) for c in "xyz"] for v in part.iter(f"{core}vertex")]
        faces = [[int(t.get(c)) for c in ("v1", "v2", "v3")] for t in part.iter(f"{core}triangle")]
        assert ("crystal" in part.get("name")) == (part.get("pindex") == "1")
        meshes[part.get("name")] = trimesh.Trimesh(vertices, faces, process=False)
    assert not objects
    return meshes


def read_folder(path) -> dict:
    return {file.stem: trimesh.load(file) for file in path.iterdir() if file.suffix == ".stl"}


@pytest.mark.parametrize("read", [read_glb, read_3mf, read_3mf_as_xml, read_folder])
def test_parts_come_back_whole_and_in_their_place(system, tmp_path, read):
    format = {read_glb: "glb", read_folder: "stl-parts"}.get(read, "3mf")
    path = tmp_path / ("scanner" if read is read_folder else f"scanner.{format}")
    mph.write_geometry(system, path, format, plate_thickness=PLATE, wall_thickness=WALL, edge_at="back")
    meshes = read(path)
    expected = {part.name: part for part in system.parts(Construction(PLATE, WALL, edge_at="back"))}
    assert set(meshes) == set(expected) and len(expected) == 24
    for key, mesh in meshes.items():
        original = trimesh.Trimesh(expected[key].vertices, expected[key].triangles, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(original.volume, rel=1e-5) and mesh.volume > 0
        assert np.allclose(mesh.bounds, original.bounds, atol=MM)

    # The fiducials: the knife edge, here on the plate's back, the hole's rim on its front, the middle of the crystal's face.
    for m, number in enumerate(system.numbers):
        pinhole, k = system.centers[m], system.principal_rays[m]
        corners = np.unique(meshes[f"Module {number} collimator"].vertices.round(5), axis=0)
        for depth in (0.0, -PLATE):
            middle = pinhole - depth * k
            radius = system.pinhole_diameter[m] / 2 + abs(depth)  # of a cone of 90 degrees
            rim = corners[np.abs(np.linalg.norm(corners - middle, axis=1) - radius) < MM]
            assert len(rim) == 64
            assert np.allclose(rim.mean(axis=0), middle, atol=MM)
            assert np.allclose((rim - middle) @ k, 0, atol=MM)
        corners = np.unique(meshes[f"Module {number} crystal"].vertices.round(5), axis=0)
        nearest = corners[np.argsort(np.linalg.norm(corners - pinhole, axis=1))[:4]]
        assert np.allclose(nearest.mean(axis=0), pinhole - system.collimator_length[m] * k, atol=MM)


@pytest.mark.parametrize(("part", "kinds"), [("all", 2), ("collimators", 1), ("crystals", 1)])
def test_one_stl_file_holds_the_parts_chosen(system, tmp_path, part, kinds):
    path = tmp_path / "scanner.STL"
    mph.write_geometry(system, path, "stl", part=part)
    assert not path.read_bytes().startswith(b"solid")  # with "solid" at the start it would be a text file
    mesh = trimesh.load(path, file_type="stl")
    parts = [p for p in system.parts() if part == "all" or p.kind == part[:-1]]
    assert len(parts) == 12 * kinds
    assert mesh.is_watertight and mesh.is_winding_consistent
    total = sum(trimesh.Trimesh(p.vertices, p.triangles, process=False).volume for p in parts)
    assert mesh.volume == pytest.approx(total, rel=1e-5)
    assert np.allclose(mesh.bounds[0], np.min([p.vertices.min(axis=0) for p in parts], axis=0), atol=MM)


def test_glb_shows_the_scanner_in_metres_and_in_colour(system, tmp_path):
    mph.write_geometry(system, tmp_path / "a.glb", "glb")
    document, _ = glb_chunks(tmp_path / "a.glb")
    assert [m["name"] for m in document["materials"]] == ["collimator", "crystal"]
    colors = [m["pbrMetallicRoughness"]["baseColorFactor"] for m in document["materials"]]
    assert colors[0] != colors[1]
    assert document["nodes"][document["scenes"][0]["nodes"][0]]["name"] == "Scanner in mm"
    assert 0.1 < np.ptp(trimesh.load(tmp_path / "a.glb").bounds, axis=0).max() < 1.0
