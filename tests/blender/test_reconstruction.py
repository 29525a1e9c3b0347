"""The Reconstruction panel and its jobs: settings, the volume in the scene, Cancel, Finish Now; back-projections."""

from __future__ import annotations

import json
import shutil

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender import ids, jobs, plots, storage, windows
from mphdrr.addon.perspective import color_bar
from mphdrr.addon.pictures import planes
from mphdrr.addon.reconstruction import backprojections, reconstructions
from mphdrr.addon.reconstruction.reconstruction_properties import (
    PROPERTIES,
    panel_properties,
    settings_recipe,
    voxels_recipe,
)
from mphdrr.addon.volumes import slices, volumes
from mphdrr.core.reconstruction.method_files import METHOD_FILES
from mphdrr.core.reconstruction.methods import METHODS, Method
from mphdrr.core.runs.files import read_run
from mphdrr.core.runs.run_recipe import run_truth
from mphdrr.core.runs.settings import SETTINGS
from mphdrr.core.volumes.sights import full_slices

from .conftest import Drawn, cancelled, datablocks, refused

SMALL = {"voxels": 14, "spacing": 7.0, "iterations": 3, "subsets": 2}


@pytest.fixture
def render(scene, derenzo):
    """Render a run of counts of a phantom in a scanner of eight modules; return a function that renders another."""
    settings = scene.mphdrr_projections
    settings.width, settings.height, settings.model, settings.time = 12, 10, "EMISSION", 600.0

    def now(**changes):
        for name, value in changes.items():
            setattr(settings, name, value)
        assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}

    now()
    return now


def shown_run() -> mph.ProjectionRun:
    return read_run(storage.absolute(bpy.context.scene.mphdrr_projections.run_file))


def reconstruction_recipe(**settings) -> mph.Recipe:
    return mph.Recipe({f"reconstruction.{name}": value for name, value in settings.items()})


def voxels_of(item) -> np.ndarray:
    return volumes.volume_from_object(item).array


def reconstructed() -> bpy.types.Object:
    return bpy.context.scene.mphdrr_reconstruction.volume


def state() -> tuple:
    """Return what a cancelled job leaves as it was."""
    files = sorted(path.name for path in storage.folder().iterdir())
    record = bpy.context.scene.mphdrr_reconstruction.record
    return datablocks("objects", "volumes", "materials", "images"), files, record


def test_the_volume_is_that_of_the_command_line(render, scene):
    assert bpy.ops.mphdrr.reconstruct(**SMALL) == {"FINISHED"}
    item = reconstructed()
    assert item.name == "Derenzo OSEM"
    assert bpy.context.object == item and item.mphdrr_volume.quantity == "activity"
    run = shown_run()
    expected = mph.reconstruct_run(run, reconstruction_recipe(**SMALL))
    found = volumes.volume_from_object(item)
    np.testing.assert_allclose(found.array, expected.volume.array, rtol=1e-6)
    np.testing.assert_allclose(found.grid.affine, expected.volume.grid.affine, atol=1e-6)
    known = scene.mphdrr_reconstruction.details
    assert known["title"] == "OSEM, 3 iterations" and known["name"] == "log-likelihood"
    np.testing.assert_allclose(known["objective"], expected.objective)
    assert [name for name, _ in known["scores"]] == ["NRMSE"] and known["voxels"] == "14 x 14 x 14 voxels of 7 mm"
    assert known["flatters"] == expected.settings["flatters"]
    rods = mph.score_volume(expected.volume, *run_truth(run)).derenzo
    assert [tuple(row) for row in known["rods"]] == [sector.cells for sector in rods if sector.rod_diameter]
    assert bpy.data.objects["Derenzo"].hide_get(), "the truth stands where the reconstruction is"
    at = full_slices(expected.volume.array)
    assert len(slices.planes_of(item)) == 3 and item.mphdrr_volume.slices[:] == tuple(at)
    truth, look = mph.resample(run.volume, expected.volume.grid, "mean"), item.mphdrr_volume
    assert look.display_high == pytest.approx(truth.array.max(), rel=1e-5), "as in the picture of its slices"
    assert look.look == "SHELL" and look.surface == pytest.approx(0.4 * look.display_high)
    assert bpy.data.images[ids.RECONSTRUCTION].size[:] == (1600, 850)


def are_planes_hidden(scene) -> bool:
    (is_hidden,) = {plane.hide_get() for plane in planes.planes(scene)}
    return is_hidden


def test_projections_make_way_for_the_result_until_they_are_wanted(render, scene):
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.mphdrr.reconstruct(**SMALL)
    bpy.ops.ed.undo_push(message="reconstructed")
    assert are_planes_hidden(scene)
    bpy.ops.ed.undo()
    scene = bpy.context.scene
    assert not are_planes_hidden(scene) and not bpy.data.objects["Derenzo"].hide_get()
    bpy.ops.ed.redo()
    scene = bpy.context.scene
    assert are_planes_hidden(scene) and bpy.data.objects["Derenzo"].hide_get()
    scene.mphdrr_display.planes = "RING"
    assert not are_planes_hidden(scene), "an edit shows them"
    bpy.ops.mphdrr.reconstruct(**SMALL)
    assert are_planes_hidden(scene) and bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    assert not are_planes_hidden(scene), "so does another run"


def test_panel_settings_count_and_scripts_override_them(render, scene):
    panel = scene.mphdrr_reconstruction
    panel.method, panel.iterations, panel.voxels, panel.spacing = "MLEM", 2, 10, 9.0
    assert bpy.ops.mphdrr.reconstruct() == {"FINISHED"}
    assert panel.details["title"] == "MLEM, 2 iterations" and reconstructed().mphdrr_volume.shape[:] == (10, 10, 10)
    first = reconstructed()
    assert bpy.ops.mphdrr.reconstruct(iterations=1) == {"FINISHED"}
    assert panel.details["title"] == "MLEM, 1 iteration"
    assert first.name in bpy.data.objects and reconstructed() != first, "a second one stands beside the first"
    assert not np.allclose(voxels_of(first), voxels_of(reconstructed()))
    refused(bpy.ops.mphdrr.reconstruct, r"Subsets needs Method OSEM", subsets=2)
    refused(bpy.ops.mphdrr.reconstruct, "Weight: missing", prior="QUADRATIC")


@pytest.mark.parametrize("name", METHODS)
def test_the_panel_untouched_gives_each_method_its_own_defaults(name, scene):
    panel, own = scene.mphdrr_reconstruction, METHODS[name].own
    panel.method = name.upper()
    recipe = settings_recipe(lambda each: getattr(panel, each), lambda each: False)
    given = {key.partition(".")[2]: value for key, value in recipe.given.items()}
    assert given.pop("method", "osem") == name
    assert all(value == own[each] for each, value in given.items() if each in own)
    assert own.keys() - {"prior", "weight"} <= dict(panel_properties(panel)).keys()
    description = panel.bl_rna.properties["iterations"].description
    assert f"OSEM 10, MLEM 50, BSREM 30, SIRT {METHODS['sirt'].own['iterations']}" in description


@pytest.mark.long
def test_without_a_number_each_method_does_its_own(render, scene):
    panel = scene.mphdrr_reconstruction
    panel.voxels, panel.spacing = 6, 16.0
    assert panel.iterations == 0
    for name, method in METHODS.items():
        if method.of_counts:
            panel.method = name.upper()
            assert bpy.ops.mphdrr.reconstruct() == {"FINISHED"}
            assert panel.details["title"] == f"{method.label}, {method.own['iterations']} iterations"


def test_a_methods_own_settings_are_in_the_panel(render, scene):
    render(model="TRANSMISSION")
    panel = scene.mphdrr_reconstruction
    panel.method, panel.voxels, panel.spacing, panel.iterations = "SIRT", 6, 16.0, 4
    panel.relaxation, panel.nonnegative = 0.5, False
    assert bpy.ops.mphdrr.reconstruct() == {"FINISHED"}
    run = shown_run()
    A = mph.projector_of_run(run, mph.Grid.centered(6, 16.0))
    expected = mph.sirt(A, run.projections, 4, relaxation=0.5, nonnegative=False).volume.array
    np.testing.assert_allclose(voxels_of(reconstructed()), expected, rtol=1e-5, atol=1e-6)


def test_a_file_can_be_the_method_and_the_result_says_so(render, scene, monkeypatch, tmp_path):
    """A network brings its own voxels; the panel's settings of other methods do not count."""
    grid = mph.Grid.centered((6, 7, 8), 12.0)

    def read(path):
        def even(A, images, progress=None):
            known = {"method": "Network", "flatters": ["it was trained for another scanner"]}
            return mph.Reconstruction(mph.Volume(np.full(A.shape_in, 2.0), A.grid), np.zeros(0), known)

        return Method(f"Network {path.name} (Toy)", "The same everywhere", even, objective="", grid=grid)

    monkeypatch.setitem(METHOD_FILES, ".toy", read)
    (tmp_path / "model.toy").touch()
    panel = scene.mphdrr_reconstruction
    panel.method, panel.prior, panel.weight, panel.iterations, panel.voxels = "BSREM", "QUADRATIC", 0.5, 4, 10
    panel.method_file = str(tmp_path / "model.toy")
    always = {"ignore_attenuation", "ignore_blur", "hole", "aperture_points", "pixel_points", "method_file"}
    assert set(dict(panel_properties(panel))) == always
    assert bpy.ops.mphdrr.reconstruct() == {"FINISHED"}
    known, found = panel.details, volumes.volume_from_object(reconstructed())
    assert known["title"] == "Network model.toy (Toy)" and known["flatters"][0] == "it was trained for another scanner"
    assert reconstructed().name.endswith("Network model.toy (Toy)") and known["objective"] == []
    assert found.grid.shape == grid.shape and (found.array == 2).all()
    np.testing.assert_allclose(found.grid.affine, grid.affine, atol=1e-6)
    refused(bpy.ops.mphdrr.reconstruct, "does not take it", iterations=3)
    panel.method_file = str(tmp_path / "model.txt")
    refused(bpy.ops.mphdrr.reconstruct, r"or a file \(\.pt, \.toy\)")
    panel.method_file = ""
    assert bpy.ops.mphdrr.reconstruct(method_file="", iterations=1) == {"FINISHED"}
    assert panel.details["title"] == "BSREM, 1 iteration"


def test_every_setting_is_in_the_panel_or_left_to_files(scene):
    panel = scene.mphdrr_reconstruction
    all_names = {key.partition(".")[2] for key in SETTINGS if key.startswith("reconstruction.")}
    of_files = {"allow", "anatomy", "stop_change", "stop_noise", "stop_region", "stop_seconds"}
    assert all_names - set(PROPERTIES) == of_files
    recipe = settings_recipe(lambda name: getattr(panel, name), lambda name: False)
    assert all(recipe[setting.key] == setting.default for setting in PROPERTIES.values())
    assert "weight" not in dict(panel_properties(panel)) and "subsets" in dict(panel_properties(panel))
    panel.prior = "RELATIVE_DIFFERENCE"
    assert {"weight", "gamma", "edge"} <= dict(panel_properties(panel)).keys()
    panel.method, panel.prior = "MLEM", "NONE"
    assert "subsets" not in dict(panel_properties(panel))


def test_without_a_run_the_buttons_say_why(scene):
    for name in ("reconstruct", "show_reconstruction", "continue_reconstruction", "backproject"):
        refused(getattr(bpy.ops.mphdrr, name), "poll")
    with pytest.raises(mph.InputError, match="nothing to back-project"):
        backprojections.backproject_job(bpy.context, mph.Recipe({}), "sum")


def test_a_radiograph_is_refused_by_methods_of_counts(render):
    render(model="TRANSMISSION")
    refused(bpy.ops.mphdrr.reconstruct, "osem needs a run of counts", **SMALL)


@pytest.fixture
def in_window(monkeypatch):
    """Pretend a window, in which what is reconstructed is shown at every step."""
    monkeypatch.setattr(reconstructions, "_MIN_INTERVAL", -1.0)
    monkeypatch.setattr(windows, "has_window", lambda: True)
    return monkeypatch


def job_of(scene) -> jobs.Job:
    panel = scene.mphdrr_reconstruction
    for name, value in SMALL.items():
        setattr(panel, name, value)
    recipe = settings_recipe(lambda name: getattr(panel, name), lambda name: False)
    return reconstructions.reconstruct_job(bpy.context, recipe)


def test_it_is_shown_while_it_runs_and_cancelled_without_a_trace(render, scene, in_window):
    before = state()
    job, seen = job_of(scene), []

    def has_two(done: int, total: int) -> bool:
        job.refresh()  # the window does so from time to time
        if reconstructed() is not None:
            seen.append(len(scene.mphdrr_reconstruction.details["objective"]))
            assert scene.mphdrr_reconstruction.details["scores"] == []
        return seen[-1:] == [2]

    cancelled(job, has_two)
    assert sorted(set(seen)) == [1, 2]
    assert (
        state() == before
        and reconstructed() is None
        and not are_planes_hidden(scene)
        and not bpy.data.objects["Derenzo"].hide_get()
    )


def test_finish_now_keeps_what_there_is(render, scene, in_window):
    files = set(storage.folder().iterdir())
    job = job_of(scene)

    def progress(done: int, total: int) -> None:
        job.refresh()
        if reconstructed() is not None:
            job.finish_now.set()

    text = jobs.run(job, progress)
    assert "OSEM, 2 iterations" in text and len(scene.mphdrr_reconstruction.details["objective"]) == 2
    assert len(set(storage.folder().iterdir()) - files) == 2, "files of states that were shown meanwhile are gone"
    assert len([item for item in volumes.volume_objects(scene) if "OSEM" in item.name]) == 1


def test_continue_goes_on_as_if_there_had_been_no_break(render, scene, in_window):
    refused(bpy.ops.mphdrr.continue_reconstruction, "poll")
    bpy.ops.mphdrr.reconstruct(**SMALL)
    first, record = reconstructed(), scene.mphdrr_reconstruction.record
    array = voxels_of(first)
    job = reconstructions.continue_job(bpy.context)

    def is_late(done: int, total: int) -> bool:
        job.refresh()
        return len(scene.mphdrr_reconstruction.details["objective"]) > 4

    cancelled(job, is_late)
    assert scene.mphdrr_reconstruction.record == record and reconstructed() == first
    np.testing.assert_array_equal(voxels_of(first), array)
    in_window.undo()
    assert bpy.ops.mphdrr.continue_reconstruction() == {"FINISHED"}
    assert reconstructed() == first and scene.mphdrr_reconstruction.details["title"] == "OSEM, 13 iterations"
    bpy.ops.mphdrr.reconstruct(**SMALL | {"iterations": 13})
    assert first.hide_get() and reconstructed() != first
    np.testing.assert_allclose(voxels_of(first), voxels_of(reconstructed()), rtol=1e-5)


def test_continue_goes_on_after_files_were_moved_and_opened_again(render, scene, tmp_path):
    bpy.ops.mphdrr.reconstruct(**SMALL)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "first.blend"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "second.blend"))
    shutil.rmtree(tmp_path / "first_mphdrr")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "second.blend"))
    assert voxels_of(reconstructed()).max() > 0
    assert bpy.context.scene.mphdrr_reconstruction.details["title"] == "OSEM, 3 iterations"
    kept = reconstructions.resume_path(bpy.context)
    assert kept.parent.name == "second_mphdrr" and kept not in storage.unused_volumes()
    assert bpy.ops.mphdrr.continue_reconstruction() == {"FINISHED"}
    first = reconstructed()
    assert bpy.context.scene.mphdrr_reconstruction.details["title"] == "OSEM, 13 iterations"
    assert kept in storage.unused_volumes()
    bpy.ops.mphdrr.reconstruct(**SMALL | {"iterations": 13})
    np.testing.assert_allclose(voxels_of(first), voxels_of(reconstructed()), rtol=1e-5)
    reconstructions.resume_path(bpy.context).unlink()
    refused(bpy.ops.mphdrr.continue_reconstruction, "poll")


def test_the_scenes_attenuation_is_modelled_and_missed(render, scene):
    bpy.ops.mphdrr.add_derenzo(voxels=12, cylinder_radius=45.0, cylinder_height=60.0, quantity="mu", background=0.0)
    mu = bpy.context.object
    scene.mphdrr_projections.volume = bpy.data.objects["Derenzo"]
    render(mu=mu)
    bpy.ops.mphdrr.reconstruct(**SMALL)
    total = voxels_of(reconstructed()).sum()
    bpy.ops.mphdrr.reconstruct(**SMALL, ignore_attenuation=True)
    assert voxels_of(reconstructed()).sum() < 0.95 * total
    bpy.data.objects.remove(mu)
    refused(bpy.ops.mphdrr.reconstruct, "is not in the scene any more", **SMALL)


def test_the_panel_draws_the_result(render, scene):
    bpy.ops.mphdrr.reconstruct(**SMALL | {"spacing": 4.0})  # not much more than that of the run
    texts = Drawn("MPHDRR_PT_reconstruction").texts
    shown = {"OSEM, 3 iterations", "Log-likelihood", "NRMSE", "Show Slices", "Continue (+10)", "Reconstruct"}
    assert shown <= set(texts)
    assert any(text.startswith("8 mm") for text in texts)
    flatters = " ".join(scene.mphdrr_reconstruction.details["flatters"])
    assert flatters and set(flatters.split()) <= set(" ".join(texts).split()), "the warning stays with the score"
    record = json.loads(scene.mphdrr_reconstruction.record)
    del record["flatters"]  # as earlier versions have it
    scene.mphdrr_reconstruction.record = json.dumps(record)
    icon = Drawn("MPHDRR_PT_reconstruction").layout.template_icon
    assert icon.call_args.kwargs["icon_value"] > 0 or bpy.app.background
    plots.stop()
    assert plots.objective_icon([1.0]) >= 0


COARSE = {"voxels": 14, "spacing": 7.0, "center": (3.0, -2.0, 1.0)}
LABELS = {"sum": "Sum", "product": "Geometric Mean", "minimum": "Minimum"}


@pytest.mark.parametrize("how", LABELS)
def test_a_back_projection_is_that_of_the_command_line(render, scene, how):
    assert bpy.ops.mphdrr.backproject(how=how.upper(), **COARSE) == {"FINISHED"}
    item = bpy.context.object
    assert item.name == f"Derenzo {LABELS[how]}"
    expected = mph.backproject_run(shown_run(), how, reconstruction_recipe(**COARSE))
    found = volumes.volume_from_object(item)
    assert found.quantity == item.mphdrr_volume.quantity == "backprojection" and expected.array.max() > 0
    np.testing.assert_allclose(found.array, expected.array, rtol=1e-6)
    np.testing.assert_allclose(found.grid.affine, expected.grid.affine, atol=1e-6)
    assert len(slices.planes_of(item)) == 3 and item.mphdrr_volume.display_high == pytest.approx(expected.array.max())
    assert color_bar.labels(item)[0].startswith("backprojection")


def test_a_back_projection_has_the_panels_voxels_and_stands_beside_the_last_one(render, scene):
    panel = scene.mphdrr_reconstruction
    panel.voxels, panel.spacing, panel.how = 10, 9.0, "MINIMUM"
    assert bpy.ops.mphdrr.backproject() == {"FINISHED"}
    first = bpy.context.object
    assert first.mphdrr_volume.shape[:] == (10, 10, 10) and first.name.endswith("Minimum")
    assert bpy.ops.mphdrr.backproject(voxels=8) == {"FINISHED"}
    assert bpy.context.object.mphdrr_volume.shape[:] == (8, 8, 8) and first.name in scene.objects


def test_a_back_projection_is_written_and_read_like_other_volumes(render, scene, tmp_path):
    bpy.ops.mphdrr.backproject(**COARSE)
    expected = volumes.volume_from_object(bpy.context.object)
    bpy.ops.mphdrr.export_volume(filepath=str(tmp_path / "sum.vdb"))
    bpy.ops.mphdrr.import_volume(filepath=str(tmp_path / "sum.vdb"), center=False)
    found = volumes.volume_from_object(bpy.context.object)
    assert found.quantity == "backprojection"
    np.testing.assert_array_equal(found.array, expected.array)


def test_a_cancelled_back_projection_leaves_everything_as_it_was(render, scene):
    before = state()
    panel = scene.mphdrr_reconstruction
    job = backprojections.backproject_job(bpy.context, voxels_recipe(lambda name: getattr(panel, name)), "product")
    cancelled(job, lambda done, total: bool(done and total))
    assert state() == before
