"""Efficiencies from Flood: the shown run's efficiencies in a file, as the command writes it, which the panel then names."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import storage
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner
from mphdrr.core.cli import main


def test_a_flood_becomes_the_panels_efficiencies(scene, ring_system, tmp_path, capsys):
    scanner.build_scanner(scene, ring_system, "Ring")
    frames = np.random.default_rng(2).poisson(2000.0, (8, 12, 12))
    frames[3] = 0
    frames[1, 4, 5] = 0
    np.save(tmp_path / "flood.npy", frames)
    assert not bpy.ops.mphdrr.flood_efficiency.poll()
    settings = scene.mphdrr_projections
    settings.model = "EMISSION"
    bpy.ops.mphdrr.import_counts(filepath=str(tmp_path / "flood.npy"), frames="1-8", orientation="front+v", time=60.0)
    run = storage.absolute(settings.run_file)
    assert bpy.ops.mphdrr.flood_efficiency(filepath=str(tmp_path / "e.npy"), order=0) == {"FINISHED"}
    assert main(["counts", "flood", str(run), "--order", "0", "-o", str(tmp_path / "by_command.npy")]) == 0
    assert (tmp_path / "e.npy").read_bytes() == (tmp_path / "by_command.npy").read_bytes()
    found = np.load(tmp_path / "e.npy")
    assert not found[3].any() and (found == 0).sum() == 145 and (found[1] == 0).sum() == 1
    assert runs.panel_recipe(scene)["model.efficiency"] == str(tmp_path / "e.npy")
    with pytest.raises(RuntimeError, match="npy"):
        bpy.ops.mphdrr.flood_efficiency(filepath=str(tmp_path / "e.txt"))
