"""The surfaces of the parts and of whole modules, by trimesh."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

from ..module_parts import ModulePart
from .report import OpenMesh


def find_open_meshes(parts: Sequence[ModulePart]) -> tuple[OpenMesh, ...]:
    """Collimators, crystals and modules whose surface is not closed, not consistently wound, or looks inwards."""
    import trimesh

    found = []
    for number, group in groupby(parts, lambda part: part.number):
        own = list(group)
        meshes = [trimesh.Trimesh(part.vertices, part.triangles, process=False) for part in own]
        names = [*(part.kind for part in own), "module"]
        for name, mesh in zip(names, [*meshes, trimesh.util.concatenate(meshes)], strict=True):
            found += [OpenMesh(number, name, fault) for fault in _faults(mesh)]
    return tuple(found)


def _faults(mesh) -> Iterable[str]:  # type: ignore[no-untyped-def]
    if not mesh.is_watertight:
        yield "is not watertight"
    elif not mesh.is_winding_consistent:
        yield "is not wound consistently"
    elif not mesh.volume > 0:
        yield f"has the volume {mesh.volume:.4g} mm^3"
