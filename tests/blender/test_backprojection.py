"""Back-projections in the scene: the volume of the command line, its settings, Cancel."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import jobs, storage
from mphdrr.addon.perspective import color_bar
from mphdrr.addon.reconstruction import backprojections
from mphdrr.addon.reconstruction.reconstruction_properties import voxels_recipe
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import slices, volumes
from mphdrr.core.progress import Cancelled
from mphdrr.core.runs.files import read_run

SMALL = {"voxels": 14, "spacing": 7.0, "center": (3.0, -2.0, 1.0)}
LABELS = {"sum": "Sum", "product": "Geometric Mean", "minimum": "Minimum"}


@pytest.fixture
def rendered(scene, ring_system):
    """A scanner of eight modules, a phantom and a run of counts."""
    scanner.build_scanner(scene, ring_system, "Ring")
    bpy.ops.mphdrr.add_derenzo(voxels=32, rod_diameters=(10, 8, 0, 0, 0, 0), location=(5, -3, 2), phi=0.2)
    settings = scene.mphdrr_projections
    settings.width, settings.height, settings.model, settings.time = 12, 10, "EMISSION", 600.0
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    return read_run(storage.absolute(settings.run_file))


@pytest.mark.parametrize("how", LABELS)
def test_the_volume_is_that_of_the_command_line(rendered, scene, how):
    assert bpy.ops.mphdrr.backproject(how=how.upper(), **SMALL) == {"FINISHED"}
    item = bpy.context.object
    assert item.name == f"{scene.mphdrr_projections.runs[0].name} {LABELS[how]}"
    recipe = mph.Recipe({f"reconstruction.{name}": value for name, value in SMALL.items()})
    expected = mph.backproject_run(rendered, how, recipe)
    found = volumes.volume_from_object(item)
    assert found.quantity == item.mphdrr_volume.quantity == "backprojection" and expected.array.max() > 0
    np.testing.assert_allclose(found.array, expected.array, rtol=1e-6)
    np.testing.assert_allclose(found.grid.affine, expected.grid.affine, atol=1e-6)
    assert len(slices.planes_of(item)) == 3 and item.mphdrr_volume.display_high == pytest.approx(expected.array.max())
    assert color_bar.labels(item)[0].startswith("backprojection")


def test_it_has_the_panels_voxels_and_stands_beside_the_last_one(rendered, scene):
    panel = scene.mphdrr_reconstruction
    panel.voxels, panel.spacing, panel.how = 10, 9.0, "MINIMUM"
    assert bpy.ops.mphdrr.backproject() == {"FINISHED"}
    first = bpy.context.object
    assert first.mphdrr_volume.shape[:] == (10, 10, 10) and first.name.endswith("Minimum")
    assert bpy.ops.mphdrr.backproject(voxels=8) == {"FINISHED"}
    assert bpy.context.object.mphdrr_volume.shape[:] == (8, 8, 8) and first.name in scene.objects


def test_it_is_written_and_read_like_other_volumes(rendered, scene, tmp_path):
    bpy.ops.mphdrr.backproject(**SMALL)
    expected = volumes.volume_from_object(bpy.context.object)
    bpy.ops.mphdrr.export_volume(filepath=str(tmp_path / "sum.vdb"))
    bpy.ops.mphdrr.import_volume(filepath=str(tmp_path / "sum.vdb"), center=False)
    found = volumes.volume_from_object(bpy.context.object)
    assert found.quantity == "backprojection"
    np.testing.assert_array_equal(found.array, expected.array)


def test_cancelled_it_leaves_everything_as_it_was(rendered, scene):
    before = sorted(item.name for item in bpy.data.objects), sorted(storage.folder().iterdir())
    panel = scene.mphdrr_reconstruction
    job = backprojections.backproject_job(bpy.context, voxels_recipe(lambda name: getattr(panel, name)), "product")

    def progress(done: int, total: int) -> None:
        if done and total:
            raise Cancelled

    with pytest.raises(Cancelled):
        jobs.run(job, progress)
    assert (sorted(item.name for item in bpy.data.objects), sorted(storage.folder().iterdir())) == before


def test_without_a_run_it_says_why(scene):
    assert not bpy.ops.mphdrr.backproject.poll()
    with pytest.raises(mph.InputError, match="nothing to back-project"):
        backprojections.backproject_job(bpy.context, mph.Recipe({}), "sum")
