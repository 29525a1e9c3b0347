"""Save As while a job runs: its result goes with the file as saved then, and nothing stays in another file's folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import mphdrr.core as mph  # noqa: E402
from mphdrr.addon.blender import jobs, storage, windows  # noqa: E402
from mphdrr.addon.phantoms import phantom_properties, phantoms  # noqa: E402
from mphdrr.addon.reconstruction import backprojections, reconstructions  # noqa: E402
from mphdrr.addon.runs import rendering, runs  # noqa: E402
from mphdrr.addon.scanner import maps  # noqa: E402
from mphdrr.addon.volumes import volume_import, volumes  # noqa: E402
from mphdrr.core.progress import Cancelled  # noqa: E402

from ..blender.conftest import derenzo, registered, ring, ring_system, scene  # noqa: E402

__all__ = ["derenzo", "registered", "ring", "ring_system", "scene"]  # fixtures


def phantom() -> jobs.Job:
    return phantoms.add_phantom_job(phantom_properties.plain_settings("derenzo", voxels=20), "New", attenuation=True)


def beating() -> jobs.Job:
    grid = mph.Grid.centered(4, 1.0)
    states = [mph.Volume(np.full(grid.shape, k, np.float32), grid, "mu") for k in (1, 2, 3)]
    return volumes.add_volume_job(
        "Making states", lambda progress: progress(1, 2) or states, "Beats", lambda *_: "Made"
    )


def projections() -> jobs.Job:
    return rendering.render_job(bpy.context, mph.Recipe({"detector.rows": 10, "detector.columns": 12}))


def frames() -> jobs.Job:
    recipe = {"detector.rows": 10, "detector.columns": 12, "model.kind": "emission", "frames.times": (10.0, 20.0)}
    return rendering.render_job(bpy.context, mph.Recipe(recipe))


def reconstruction() -> jobs.Job:
    recipe = {"method": "cgls", "voxels": 12, "spacing": 8.0, "iterations": 3}
    return reconstructions.reconstruct_job(
        bpy.context, mph.Recipe({f"reconstruction.{name}": value for name, value in recipe.items()})
    )


def backprojection() -> jobs.Job:
    recipe = mph.Recipe({"reconstruction.voxels": 12, "reconstruction.spacing": 8.0})
    return backprojections.backproject_job(bpy.context, recipe, "sum")


def sensitivity_map() -> jobs.Job:
    return maps.map_job(bpy.context.scene, "sensitivity", voxels=8)


def dose() -> jobs.Job:
    """Return a job whose quantity has two words."""
    return volume_import.dose_job(bpy.data.objects["Derenzo"], "Tc-99m")


JOBS = [phantom, beating, projections, frames, reconstruction, backprojection, sensitivity_map, dose]


@pytest.fixture
def study(derenzo, tmp_path, monkeypatch) -> Path:
    """Save a scene with a phantom and a run."""
    bpy.ops.mphdrr.render_projections(width=12, height=10)
    path = tmp_path / "a" / "study.blend"
    path.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


@pytest.fixture
def shown(monkeypatch) -> None:
    """Let reconstructions show each iteration, as in a window."""
    monkeypatch.setattr(reconstructions, "_MIN_INTERVAL", 0.0)
    monkeypatch.setattr(windows, "has_window", lambda: True)
    for name in ("open_editor", "editor_size", "show_below"):
        monkeypatch.setattr(reconstructions.images, name, lambda *_: None)


def files_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.name.endswith(".blend1")}


def run_with(job: jobs.Job, act: Callable[[], object], moment: str = "after") -> None:
    """Run a job and `act` before, during or after its work, which is before its end; results so far are shown."""
    acts = [act]
    if moment == "before":
        acts.pop()()

    def progress(done: int, total: int) -> None:
        job.refresh()
        if moment == "during" or (moment == "late" and bpy.context.scene.mphdrr_reconstruction.volume):
            acts.pop()() if acts else None

    if moment == "after":
        value = job.work(progress)
        acts.pop()()
        job.work = lambda _: value
    assert jobs.run(job, progress) and not acts


MOMENTS = [(make, moment) for make in JOBS for moment in ("before", "during", "after")]


@pytest.mark.parametrize(("make", "moment"), [*MOMENTS, (reconstruction, "late")])
def test_a_result_goes_with_the_file_that_was_saved_meanwhile(study, shown, tmp_path, make, moment):
    before, new = files_below(study.parent), tmp_path / "b" / "other.blend"
    new.parent.mkdir()
    run_with(make(), lambda: bpy.ops.wm.save_as_mainfile(filepath=str(new)), moment)
    assert files_below(study.parent) == before
    named = [storage.absolute(getattr(owner, name)) for owner, name in storage.file_references()]
    assert all(path.is_relative_to(new.parent) for path in named) and storage.missing_volumes() == []
    n_volumes, n_runs = len(bpy.data.volumes), len(bpy.context.scene.mphdrr_projections.runs)
    assert storage.unused_volumes() == []
    bpy.ops.wm.save_mainfile()
    shutil.move(new.parent, tmp_path / "c")
    shutil.rmtree(study.parent)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "c" / "other.blend"))
    assert (len(bpy.data.volumes), len(bpy.context.scene.mphdrr_projections.runs)) == (n_volumes, n_runs)
    assert storage.missing_volumes() == [] and runs.shown_run(bpy.context.scene) is not None
    assert all(volumes.volume_from_object(item).array.size for item in volumes.volume_objects(bpy.context.scene))


@pytest.mark.parametrize("make", [phantom, projections, sensitivity_map])
def test_a_first_save_takes_the_result_of_a_running_job(derenzo, tmp_path, make):
    path = tmp_path / "first.blend"
    bpy.ops.mphdrr.render_projections(width=12, height=10)
    run_with(make(), lambda: bpy.ops.wm.save_as_mainfile(filepath=str(path)))
    named = [storage.absolute(getattr(owner, name)) for owner, name in storage.file_references()]
    assert {file.parent for file in named} == {tmp_path / "first_mphdrr"} and storage.missing_volumes() == []


def test_files_that_the_other_blend_needs_stay_there(study, tmp_path):
    """A job may make a file again that is there already: its name is made from the content."""
    item = next(iter(volumes.volume_objects(bpy.context.scene)))
    before, old = files_below(study.parent), storage.absolute(item.data.filepath)
    job = phantoms.update_phantom_job(item)
    run_with(job, lambda: bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend")))
    assert files_below(study.parent) == before and old.is_file()
    assert storage.absolute(item.data.filepath) == tmp_path / "other_mphdrr" / old.name


def test_a_saved_copy_leaves_the_result_with_the_session(study, tmp_path):
    before, copy = files_below(study.parent), tmp_path / "copy.blend"
    run_with(phantom(), lambda: bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True))
    assert len(files_below(study.parent) - before) == 2
    named = [storage.absolute(getattr(owner, name)) for owner, name in storage.file_references()]
    assert all(path.is_relative_to(study.parent) for path in named) and storage.missing_volumes() == []


@pytest.mark.parametrize("make", [phantom, projections, reconstruction])
def test_a_job_cancelled_after_save_as_leaves_no_file(study, shown, tmp_path, make):
    before = files_below(study.parent)

    def save_and_cancel() -> None:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
        raise Cancelled

    with pytest.raises(Cancelled):
        run_with(make(), save_and_cancel, "late" if make is reconstruction else "during")
    assert files_below(study.parent) == before and storage.unused_volumes() == []
