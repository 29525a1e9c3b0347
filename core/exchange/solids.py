"""The modules as solids: STL, 3MF and GLB of collimators, with their aperture plates, and of crystals.

Every part is a closed surface of its own, in world mm: origin at the isocentre, +z along the patient. 3MF and GLB name the
parts ("Module 07 collimator") and colour them; an STL file can do neither, so there is also a folder with a file for each.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import InputError
from ..geometry.collimator import Construction, EdgePlace, angle_from_degrees
from ..geometry.module_parts import ModulePart, module_parts
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..version import VERSION
from .format import Format

Which = Literal["all", "collimators", "crystals"]

_KINDS = {"collimators": ("collimator",), "crystals": ("crystal",), "all": ("collimator", "crystal")}
_MATERIALS = ("collimator", "crystal")


def _chosen(
    system: PinholeSystem,
    part: Which,
    plate_thickness: float,
    wall_thickness: float,
    opening_degrees: float,
    edge_at: EdgePlace,
) -> list[ModulePart]:
    if part not in _KINDS:
        raise InputError(f"part {part!r}: expected one of {', '.join(_KINDS)}")
    construction = Construction(plate_thickness, wall_thickness, angle_from_degrees(opening_degrees), edge_at)
    return [p for p in module_parts(system, construction) if p.kind in _KINDS[part]]


def write_stl(
    system: PinholeSystem,
    views: Views,
    path: Path,
    part: Which = "all",
    plate_thickness: float = 2.0,
    wall_thickness: float = 2.0,
    opening_degrees: float = 90.0,
    edge_at: EdgePlace = "middle",
) -> None:
    """One binary STL file of all chosen parts.

    Parameters
    ----------
    part
        ``"collimators"``, ``"crystals"`` or ``"all"``.
    plate_thickness, wall_thickness
        Of the aperture plates and of the collimators' walls, mm.
    opening_degrees, edge_at
        Full angle of the holes' double cone, and where in the plate its edge is: ``"middle"``, or the face in ``"front"``,
        towards the ROI, or ``"back"``.
    """
    path.write_bytes(_stl(_chosen(system, part, plate_thickness, wall_thickness, opening_degrees, edge_at)))


def write_stl_parts(
    system: PinholeSystem,
    views: Views,
    path: Path,
    part: Which = "all",
    plate_thickness: float = 2.0,
    wall_thickness: float = 2.0,
    opening_degrees: float = 90.0,
    edge_at: EdgePlace = "middle",
) -> None:
    """A binary STL file for each part, named as the part is; options as those of `write_stl`."""
    for chosen in _chosen(system, part, plate_thickness, wall_thickness, opening_degrees, edge_at):
        (path / f"{chosen.name}.stl").write_bytes(_stl([chosen]))


def _stl(parts: list[ModulePart]) -> bytes:
    corners = np.concatenate([p.vertices[p.triangles] for p in parts])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facets = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    facets["corners"] = corners
    header = f"mphDRR {VERSION}, mm".encode().ljust(80)
    return header + np.uint32(len(facets)).astype("<u4").tobytes() + facets.tobytes()


_CONTENT_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
_RELATIONSHIPS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Id="rel0" Target="/3D/3dmodel.model" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""


def write_3mf(
    system: PinholeSystem,
    views: Views,
    path: Path,
    part: Which = "all",
    plate_thickness: float = 2.0,
    wall_thickness: float = 2.0,
    opening_degrees: float = 90.0,
    edge_at: EdgePlace = "middle",
) -> None:
    """3MF (Core Specification 1.2) in millimetres, a named object for each part; options as those of `write_stl`."""
    parts = _chosen(system, part, plate_thickness, wall_thickness, opening_degrees, edge_at)
    first = 2  # the materials are resource 1
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<model unit="millimeter" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">',
        f'<metadata name="Application">mphDRR {VERSION}</metadata>',
        '<resources><basematerials id="1">',
        '<base name="collimator" displaycolor="#A2A8B0"/><base name="crystal" displaycolor="#FFB845"/>',
        "</basematerials>",
    ]
    for identity, p in enumerate(parts, start=first):
        material = _MATERIALS.index(p.kind)
        lines.append(
            f'<object id="{identity}" type="model" name="{p.name}" pid="1" pindex="{material}"><mesh><vertices>'
        )
        lines += [f'<vertex x="{x:.7f}" y="{y:.7f}" z="{z:.7f}"/>' for x, y, z in p.vertices.tolist()]
        lines.append("</vertices><triangles>")
        lines += [f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in p.triangles.tolist()]
        lines.append("</triangles></mesh></object>")
    lines.append("</resources><build>")
    lines += [f'<item objectid="{identity}"/>' for identity in range(first, first + len(parts))]
    lines.append("</build></model>\n")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as package:
        for name, text in (
            ("[Content_Types].xml", _CONTENT_TYPES),
            ("_rels/.rels", _RELATIONSHIPS),
            ("3D/3dmodel.model", "\n".join(lines)),
        ):
            package.writestr(name, text)


# Tungsten and scintillator, as in the scene. Colours are linear.
_GLB_MATERIALS = [
    {
        "name": "collimator",
        "pbrMetallicRoughness": {
            "baseColorFactor": [0.36, 0.39, 0.43, 1.0],
            "metallicFactor": 0.85,
            "roughnessFactor": 0.42,
        },
    },
    {
        "name": "crystal",
        "alphaMode": "BLEND",
        "pbrMetallicRoughness": {
            "baseColorFactor": [1.0, 0.48, 0.06, 0.85],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.12,
        },
    },
]
_FLOAT, _UNSIGNED_SHORT, _VERTEX_BUFFER, _INDEX_BUFFER = 5126, 5123, 34962, 34963  # OpenGL's numbers


def write_glb(
    system: PinholeSystem,
    views: Views,
    path: Path,
    part: Which = "all",
    plate_thickness: float = 2.0,
    wall_thickness: float = 2.0,
    opening_degrees: float = 90.0,
    edge_at: EdgePlace = "middle",
) -> None:
    """Binary glTF 2.0, a named mesh for each part; options as those of `write_stl`.

    The meshes are in world mm. glTF's unit is the metre and its +y points up, so they hang on one node that scales by 0.001
    and turns +z to +y: programs that read glTF show the scanner in its true size.
    """
    parts = _chosen(system, part, plate_thickness, wall_thickness, opening_degrees, edge_at)
    accessors: list[dict[str, Any]] = []
    positions, indices = b"", b""
    for p in parts:
        points, corners = p.vertices.astype("<f4"), p.triangles.astype("<u2")
        accessors += [
            {
                "bufferView": 0,
                "byteOffset": len(positions),
                "componentType": _FLOAT,
                "count": len(points),
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "byteOffset": len(indices),
                "componentType": _UNSIGNED_SHORT,
                "count": corners.size,
                "type": "SCALAR",
            },
        ]
        positions += points.tobytes()
        indices += corners.tobytes()
    meshes = [
        {
            "name": p.name,
            "primitives": [
                {
                    "attributes": {"POSITION": 2 * i},
                    "indices": 2 * i + 1,
                    "material": _MATERIALS.index(p.kind),
                }
            ],
        }
        for i, p in enumerate(parts)
    ]
    scanner = {
        "name": "Scanner in mm",
        "rotation": [-(0.5**0.5), 0.0, 0.0, 0.5**0.5],
        "scale": [0.001, 0.001, 0.001],
        "children": list(range(1, len(parts) + 1)),
    }
    document = {
        "asset": {"version": "2.0", "generator": f"mphDRR {VERSION}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [scanner, *({"name": p.name, "mesh": i} for i, p in enumerate(parts))],
        "meshes": meshes,
        "materials": _GLB_MATERIALS,
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteLength": len(positions), "byteStride": 12, "target": _VERTEX_BUFFER},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices), "target": _INDEX_BUFFER},
        ],
        "buffers": [{"byteLength": len(positions) + len(indices)}],
    }
    chunks = b"".join(
        _chunk(kind, data, fill)
        for kind, data, fill in (
            (b"JSON", json.dumps(document, separators=(",", ":")).encode(), b" "),
            (b"BIN\0", positions + indices, b"\0"),
        )
    )
    path.write_bytes(b"glTF" + np.array([2, 12 + len(chunks)], "<u4").tobytes() + chunks)


def _chunk(kind: bytes, data: bytes, fill: bytes) -> bytes:
    data += fill * (-len(data) % 4)
    return np.array([len(data)], "<u4").tobytes() + kind + data


STL = Format("stl", "binary STL of the solids, one file, mm", (".stl",), write_stl)
STL_PARTS = Format("stl-parts", "a folder with a binary STL for each part, mm", (), write_stl_parts)
THREE_MF = Format("3mf", "3MF of the solids, named objects, mm", (".3mf",), write_3mf)
GLB = Format("glb", "binary glTF of the solids, named meshes, shown in metres", (".glb",), write_glb)
