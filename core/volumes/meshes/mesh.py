"""Triangle meshes, their files, and the check that a mesh is closed."""

import io
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Floats, Integers
from ...errors import InputError, expecting, reading
from ...files import AnyPath, replacing, require_ending, require_file
from ...validation import freeze, one_of, real_array

MESH_FORMATS = (".stl", ".obj", ".ply", ".glb")
"""Name endings of mesh files."""
MILLIMETRES = {"um": 0.001, "mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
"""Millimetres per unit of length of a mesh file, by unit."""

_LOOKS = ("KHR_materials", "KHR_texture", "KHR_lights", "KHR_xmp")  # extensions of glTF that change no shape
_FLOAT = 5126  # component type of glTF
# Corners closer to each other than this fraction of the mesh's size are one corner: files have six digits or more.
_SAME_POINT = 1e-7


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles."""

    vertices: Floats
    """Vertices (V, 3), world mm."""
    faces: Integers
    """Indices (F, 3) of each triangle's corners in `vertices`, counter-clockwise as seen from outside."""

    def __post_init__(self) -> None:
        vertices = real_array(self.vertices, "mesh vertices", (None, 3))
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            actual = f"{faces.dtype} of shape {faces.shape}"
            raise InputError(f"mesh faces: expected F x 3 indices of vertices, got {actual}")
        if len(faces) == 0:
            raise InputError("mesh: it has no faces")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(f"mesh faces: expected indices from 0 to {len(vertices) - 1}")
        object.__setattr__(self, "vertices", freeze(vertices))
        object.__setattr__(self, "faces", freeze(faces.astype(np.int64)))

    @property
    def volume(self) -> float:
        """Enclosed volume, mm^3; positive if the faces look outwards."""
        # Relative to the mean vertex, so that no digits are lost far from the origin.
        a, b, c = ((self.vertices - self.vertices.mean(axis=0))[self.faces[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def read_mesh(path: AnyPath, unit: str | None = None) -> Mesh:
    """Read a mesh file, .stl, .obj, .ply or .glb, with the triangles of all its objects as one mesh.

    `unit` is the unit of length in the file, one of `MILLIMETRES`. Default: mm; for .glb m, as its standard says.
    """
    import trimesh

    path = Path(path)
    suffix, factor = _suffix_and_factor(path, unit)
    with reading(path, suffix):
        content = require_file(path).read_bytes()
        if suffix == ".obj":  # trimesh takes a comment behind a face for corners, and no lines that end with CR alone
            content = re.sub(rb"#[^\r\n]*", b"", content).replace(b"\r", b"\n")
            # It counts relative indices from the file's last vertex, not from the face's.
            if re.search(rb"^f[^\n]*[ \t]-.*\nv[ \t]", content, re.MULTILINE | re.DOTALL):
                raise InputError("faces with relative indices stand before further vertices: export absolute ones")
        elif suffix == ".glb":
            _require_plain_gltf(content)
        elif suffix == ".stl":
            _require_whole_stl(content)
        mesh = trimesh.load(io.BytesIO(content), file_type=suffix[1:], process=False, force="mesh")
        return Mesh(np.asarray(mesh.vertices) * factor, np.asarray(mesh.faces))


def _require_plain_gltf(content: bytes) -> None:
    """Raise `InputError` for contents of a .glb of which trimesh reads another shape than glTF 2.0 says."""
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    unknown = [name for name in header.get("extensionsRequired", ()) if not name.startswith(_LOOKS)]
    meshes, accessors = header.get("meshes", ()), header.get("accessors", ())
    primitives = [primitive for mesh in meshes for primitive in mesh.get("primitives", ())]
    indices = [index for p in primitives for index in (p["attributes"].get("POSITION"), p.get("indices"))]
    used = [accessors[index] for index in indices if index is not None]
    weights = [item.get("weights", ()) for item in (*meshes, *header.get("nodes", ()))]
    for problem, is_there in (
        (f"it requires {', '.join(unknown)}", unknown),
        ("its positions are quantized", any(a["type"] == "VEC3" and a["componentType"] != _FLOAT for a in used)),
        ("it has sparse accessors", any("sparse" in accessor for accessor in used)),
        ("it has morph targets with weights", any(map(any, weights))),
        ("its skin moves it", any("skin" in node for node in header.get("nodes", ()))),
    ):
        if is_there:
            raise InputError(f"{problem}, which is not read: export the mesh without it, or as .ply")


def _require_whole_stl(content: bytes) -> None:
    """Raise `InputError` for an .stl file that is cut short, or goes on behind its triangles."""
    size = 84 + 50 * int.from_bytes(content[80:84], "little")
    if content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:1024].lower():
        if not re.search(rb"endsolid[^\r\n]*\s*$", content[-1024:].lower()):
            raise InputError("it ends before endsolid: it is cut short")
    elif len(content) != size:
        expected = f"expected {size} bytes of {(size - 84) // 50} triangles, found {len(content)}"
        raise InputError(f"{expected}: it is cut short, or has something behind them")


def write_mesh(mesh: Mesh, path: AnyPath, unit: str | None = None) -> None:
    """Write a mesh as .stl, .obj, .ply or .glb; `unit` is the unit of length in the file, see `read_mesh`."""
    import trimesh

    path = Path(path)
    suffix, factor = _suffix_and_factor(path, unit)
    mesh = as_mesh(mesh)
    with replacing(path) as temporary:
        trimesh.Trimesh(mesh.vertices / factor, mesh.faces, process=False).export(temporary, file_type=suffix[1:])


def as_mesh(source: Any) -> Mesh:
    """Return a `Mesh` from a mesh, a trimesh mesh or scene, (vertices, faces), or the path of a file."""
    if isinstance(source, Mesh):
        return source
    if isinstance(source, str | os.PathLike):
        return read_mesh(source)
    if hasattr(source, "to_mesh"):  # a trimesh scene
        source = source.to_mesh()
    if hasattr(source, "vertices") and hasattr(source, "faces"):
        return Mesh(source.vertices, source.faces)
    refusal = f"mesh: expected a mesh, vertices and faces, or a path, got {type(source).__name__}"
    with expecting(refusal, TypeError, ValueError):
        vertices, faces = source
    return Mesh(vertices, faces)


def require_closed(mesh: Mesh) -> None:
    """Raise `InputError` for a surface that is open or whose faces look to different sides; the message says where."""
    vertices = mesh.vertices
    size = float(np.ptp(vertices, axis=0).max())
    # In .stl and other files every triangle has its own copy of its corners: equal corners are merged.
    steps = np.round((vertices - vertices.min(axis=0)) / (_SAME_POINT * size or 1.0))
    order = np.lexsort(steps.T)
    is_new = np.append(True, (np.diff(steps[order], axis=0) != 0).any(axis=1))
    first, merged = order[is_new], np.empty(len(vertices), np.int64)
    merged[order] = np.cumsum(is_new) - 1
    corners = merged[mesh.faces]
    # A triangle with two equal corners has no area, and its edges cancel.
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    key, index = np.unique(np.minimum(start, end) * len(first) + np.maximum(start, end), return_inverse=True)
    edge = np.stack(np.divmod(key, len(first)))
    n_faces = np.bincount(index)
    direction_sum = np.bincount(index, np.where(start < end, 1, -1))  # 0 if faces run along the edge in both directions
    for is_wrong, fault, remedy in (
        (n_faces % 2, "it is not closed", "expected an even number of faces at each edge: fill the holes"),
        (direction_sum, "faces look to different sides", "expected all to look outwards: recalculate the normals"),
    ):
        if len(wrong := np.flatnonzero(is_wrong)):
            x, y, z = vertices[first[edge[:, wrong[0]]]].mean(axis=0)
            count = f"{len(wrong)} edge{'s' * (len(wrong) > 1)}"
            raise InputError(f"mesh: {fault} at {count}, the first at ({x:.4g}, {y:.4g}, {z:.4g}) mm; {remedy}")


def _suffix_and_factor(path: Path, unit: str | None) -> tuple[str, float]:
    """Return the path's ending, and the millimetres per unit of length of the file."""
    suffix = require_ending(path, MESH_FORMATS)
    unit = unit or ("m" if suffix == ".glb" else "mm")
    one_of(unit, MILLIMETRES, "unit")
    return suffix, MILLIMETRES[unit]
