"""Formats of solids: STL, 3MF and GLB of collimators, with their aperture plates, and of crystals.

Every part is a separate closed surface in world mm: origin at the isocentre, +z along the patient. 3MF and GLB hold the
parts' names ("Module 07 collimator") and colours. STL has neither, so there is also a format with one file for each part.
"""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..geometry.collimator import Construction, EdgePlace, angle_from_degrees
from ..geometry.module_parts import ModulePart
from ..geometry.part_colors import LOOKS
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..validation import one_of
from ..version import VERSION
from .format import Format

_PART_KINDS = {"collimators": ("collimator",), "crystals": ("crystal",), "all": tuple(LOOKS)}
_Save = Callable[[Path, list[ModulePart]], None]


def _solid_format(name: str, title: str, suffixes: tuple[str, ...], save: _Save) -> Format:
    """Return the format of the parts that its options choose, which `save` writes."""

    def write(
        system: Scanner,
        views: Views,
        temporary: Path,
        *,
        part: Literal["all", "collimators", "crystals"] = "all",
        plate_thickness: float = 2.0,
        wall_thickness: float = 2.0,
        opening_degrees: float = 90.0,
        edge_at: EdgePlace = "middle",
    ) -> None:
        """Write the parts of the system's modules; the keyword-only arguments are the options of the format."""
        one_of(part, _PART_KINDS, "part")
        construction = Construction(plate_thickness, wall_thickness, angle_from_degrees(opening_degrees), edge_at)
        save(temporary, [p for p in system.parts(construction) if p.kind in _PART_KINDS[part]])

    return Format(name, title, suffixes, write)


def _save_stl(temporary: Path, parts: list[ModulePart]) -> None:
    """Write all parts into one binary STL file."""
    import trimesh

    meshes = [trimesh.Trimesh(p.vertices, p.triangles, process=False) for p in parts]
    temporary.write_bytes(trimesh.util.concatenate(meshes).export(file_type="stl"))


def _save_stl_parts(temporary: Path, parts: list[ModulePart]) -> None:
    """Write a folder with a binary STL file for each part."""
    for p in parts:
        _save_stl(temporary / f"{p.name}.stl", [p])


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


def _save_3mf(temporary: Path, parts: list[ModulePart]) -> None:
    """Write 3MF (Core Specification 1.2) in millimetres, with a named object for each part."""
    bases, looks = [], {kind: look for kind, look in LOOKS.items() if any(p.kind == kind for p in parts)}
    for kind, look in looks.items():  # colours of `LOOKS` are linear, those of 3MF sRGB
        shares = (1.055 * x ** (1 / 2.4) - 0.055 if x > 0.0031308 else 12.92 * x for x in look.color[:3])
        color = "".join(f"{round(255 * share):02X}" for share in shares)
        bases.append(f'<base name="{kind}" displaycolor="#{color}"/>')
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<model unit="millimeter" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">',
        f'<metadata name="Application">mphDRR {VERSION}</metadata>',
        f'<resources><basematerials id="1">{"".join(bases)}</basematerials>',
    ]
    numbered = list(enumerate(parts, start=2))  # the materials are resource 1
    for number, p in numbered:
        material = list(looks).index(p.kind)
        lines.append(f'<object id="{number}" type="model" name="{p.name}" pid="1" pindex="{material}"><mesh><vertices>')
        lines += [f'<vertex x="{x:.7f}" y="{y:.7f}" z="{z:.7f}"/>' for x, y, z in p.vertices.tolist()]
        lines.append("</vertices><triangles>")
        lines += [f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in p.triangles.tolist()]
        lines.append("</triangles></mesh></object>")
    lines += ["</resources><build>", *(f'<item objectid="{number}"/>' for number, _ in numbered), "</build></model>\n"]
    with zipfile.ZipFile(memory := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as package:
        package.writestr("[Content_Types].xml", _CONTENT_TYPES)
        package.writestr("_rels/.rels", _RELATIONSHIPS)
        package.writestr("3D/3dmodel.model", "\n".join(lines))
    temporary.write_bytes(memory.getbuffer())


def _save_glb(temporary: Path, parts: list[ModulePart]) -> None:
    """Write binary glTF 2.0, with a named mesh for each part.

    The meshes are in world mm. glTF's unit is the metre and its +y points up, so all meshes are children of one node that
    scales by 0.001 and turns +z to +y: programs that read glTF show the scanner in its true size.
    """
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    materials = {}
    for kind, look in LOOKS.items():
        factors: Any = {"metallicFactor": look.metallic, "roughnessFactor": look.roughness}
        factors["baseColorFactor"] = [round(255 * share) for share in look.color]
        materials[kind] = PBRMaterial(kind, **factors, alphaMode="OPAQUE" if look.color[3] == 1.0 else "BLEND")
    to_metres = np.diag([0.001, 0.001, 0.001, 1.0])
    to_metres[1:3, 1:3] = [[0.0, 0.001], [-0.001, 0.0]]
    scene = trimesh.Scene()
    scene.graph.update("Scanner in mm", matrix=to_metres)
    for p in parts:
        visual = TextureVisuals(material=materials[p.kind])
        mesh = trimesh.Trimesh(p.vertices, p.triangles, process=False, visual=visual)
        scene.add_geometry(mesh, node_name=p.name, geom_name=p.name, parent_node_name="Scanner in mm")
    temporary.write_bytes(scene.export(file_type="glb"))


STL = _solid_format("stl", "binary STL of the solids, one file, mm", (".stl",), _save_stl)
STL_PARTS = _solid_format("stl-parts", "a folder with a binary STL for each part, mm", (), _save_stl_parts)
THREE_MF = _solid_format("3mf", "3MF of the solids, named objects, mm", (".3mf",), _save_3mf)
GLB = _solid_format("glb", "binary glTF of the solids, named meshes, shown in metres", (".glb",), _save_glb)
