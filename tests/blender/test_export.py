"""File > Export > mphDRR Dataset: the last run, in three formats."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.runs.files import read_run


@pytest.fixture
def rendered(scene, ring_system):
    """A scene whose projections are rendered."""
    scanner.build_scanner(scene, ring_system, "Ring")
    bpy.ops.mphdrr.add_derenzo(voxels=16, rod_diameters=(10, 8, 0, 0, 0, 0))
    bpy.ops.mphdrr.render_projections(width=8, height=6)
    return scene


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".pt"])
def test_dataset_holds_the_run_whole(rendered, tmp_path, suffix, ring_system):
    if suffix == ".pt":
        pytest.importorskip("torch", reason=".pt files need torch")
    path = tmp_path / f"run{suffix}"
    assert bpy.ops.mphdrr.export_dataset(filepath=str(path)) == {"FINISHED"}
    run = read_run(path)
    kept = read_run(rendered.mphdrr_projections.run_file)
    assert np.array_equal(run.projections, kept.projections) and run.projections.shape == (8, 6, 8)
    assert np.array_equal(run.volume.array, volumes.volume_from_object(bpy.data.objects["Derenzo"]).array)
    np.testing.assert_allclose(run.system.centers, ring_system.centers)
    assert run.settings["detector"] == "virtual"


@pytest.mark.parametrize(
    ("name", "message"), [("run.txt", "expected a name ending in"), ("nowhere/run.h5", "no such folder"), ("", "file")]
)
def test_wrong_names_are_clear_errors_and_nothing_is_written(rendered, tmp_path, name, message):
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.mphdrr.export_dataset(filepath=str(tmp_path / name) if name else "")
    assert list(tmp_path.iterdir()) == []


def test_nothing_to_export_is_a_clear_error(tmp_path):
    with pytest.raises(RuntimeError, match="render the projections first"):
        bpy.ops.mphdrr.export_dataset(filepath=str(tmp_path / "run.h5"))
