"""What the scene leaves open is told: which of several scanners is exported, and voxels of objects made in metres."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import mphdrr.core as mph  # noqa: E402
from mphdrr.addon.scanner import scanner  # noqa: E402
from mphdrr.addon.volumes import volumes  # noqa: E402

from ..blender.conftest import registered, ring_system, scene, select  # noqa: E402

__all__ = ["registered", "ring_system", "scene"]  # fixtures


@pytest.mark.parametrize("chosen", ["One", "Two", None])
@pytest.mark.parametrize("operator", ["export_geometry", "export_for_program"])
def test_an_export_names_the_scanner_that_it_took(scene, ring_system, tmp_path, capfd, chosen, operator):
    scanners = {name: scanner.build_scanner(scene, ring_system[:n], name) for name, n in (("One", 3), ("Two", 5))}
    scene.mphdrr_geometry.scanner = scanners.get(chosen)
    bpy.context.view_layer.objects.active = None
    capfd.readouterr()
    format = {"format": "stl-parts"} if operator == "export_for_program" else {}
    path = tmp_path / ("stl" if format else "w.xlsx")
    assert getattr(bpy.ops.mphdrr, operator)(filepath=str(path), **format) == {"FINISHED"}
    name = chosen or "One"
    n = len(scanner.modules(scanners[name]))
    assert f"Wrote {n} modules of '{name}' to " in capfd.readouterr().out
    assert format or len(mph.read_system(path)) == n


@pytest.mark.parametrize(
    ("size", "voxels", "is_tiny"), [(0.1, 128, True), (0.02, 40, True), (30.0, 64, False), (0.1, 50, False)]
)
def test_voxels_below_a_micrometre_are_warned_of(scene, capfd, size, voxels, is_tiny):
    bpy.ops.mesh.primitive_cube_add(size=size)
    capfd.readouterr()
    assert bpy.ops.mphdrr.voxelize_objects(voxels=voxels) == {"FINISHED"}
    assert ("below a micrometre" in capfd.readouterr().out) == is_tiny


@pytest.mark.parametrize(("scale", "is_tiny"), [(1e-3, False), (4e-4, True), ((1.0, 1e-4, 1.0), True), (1.0, False)])
def test_scaled_volumes_are_warned_of(scene, ring_system, capfd, scale, is_tiny):
    scanner.build_scanner(scene, ring_system, "Ring")
    item = volumes.add_volume(mph.Volume(np.ones((3, 4, 5), np.float32), mph.Grid.centered((3, 4, 5), 2.0)), "Box")
    item.scale = np.broadcast_to(scale, 3)
    select(item)
    capfd.readouterr()
    assert bpy.ops.mphdrr.render_projections(width=8, height=6) == {"FINISHED"}
    assert ("below a micrometre" in capfd.readouterr().out) == is_tiny
