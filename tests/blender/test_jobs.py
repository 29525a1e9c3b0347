"""Jobs: what they say, the queue, and that cancelling them in any stage leaves everything as it was."""

import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from mphdrr.addon import example
from mphdrr.addon.blender import ids, jobs, storage
from mphdrr.addon.phantoms import phantoms
from mphdrr.addon.phantoms.phantom_properties import plain_settings
from mphdrr.addon.pictures import images, planes
from mphdrr.addon.runs import rendering
from mphdrr.addon.scanner import maps, scanner, scanner_files
from mphdrr.addon.volumes import volume_import, volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.progress import Cancelled, StagedProgress
from mphdrr.core.runs.recipe import Recipe
from mphdrr.core.volumes.volume import Volume
from mphdrr.core.volumes.volume_files import write_volume

from .conftest import refused, reopened


@pytest.fixture
def scanned(derenzo):
    """Make a scanner, a phantom that is active, and a run of its projections."""
    bpy.ops.mphdrr.render_projections(width=10, height=12)


_UNREAD = ("pixels", "has_data", "cycles")  # compared as an array; a cache; with properties that cannot be read


def everything() -> dict[str, object]:
    """Return all that the file holds, and the run files: users, properties, custom properties and pixels."""
    found: dict[str, object] = {}

    def describe(path: str, item: bpy.types.bpy_struct) -> None:
        for name, property in item.bl_rna.properties.items():
            if name == "rna_type" or name in _UNREAD:
                continue
            value = getattr(item, name, None)
            if property.type == "POINTER":
                if isinstance(value, bpy.types.PropertyGroup):
                    describe(f"{path}.{name}", value)
                else:
                    found[f"{path}.{name}"] = getattr(value, "name", None)
            elif property.type == "COLLECTION":
                found[f"{path}.{name}"] = [getattr(each, "name", "") for each in value]
            else:
                found[f"{path}.{name}"] = value[:] if getattr(property, "is_array", False) else value

    for kind in ("scenes", "collections", "objects", "images", "cameras", "meshes", "materials", "volumes", "texts"):
        for item in getattr(bpy.data, kind):
            path = f"{kind} {item.name}"
            found[f"{path} users"] = item.users
            own = {key: value for key, value in item.items() if key not in item.bl_rna.properties}
            found[f"{path} custom"] = {k: v.to_list() if hasattr(v, "to_list") else str(v) for k, v in own.items()}
            if kind == "images":
                pixels = np.empty(len(item.pixels), np.float32)
                item.pixels.foreach_get(pixels)
                found[f"{path} pixels"] = pixels.tobytes()
            describe(path, item)
    found["run files"] = {path.name: path.read_bytes() for path in storage.folder().glob("*.h5")}
    return found


def projecting() -> jobs.Job:
    return rendering.render_job(bpy.context, Recipe({"detector.rows": 9, "detector.columns": 14}), "Derenzo")


def importing(path: Path) -> jobs.Job:
    write_volume(Volume(np.ones((3, 4, 5)), Grid.centered((3, 4, 5), 2.0), "hu"), path / "ct.nii")
    return volume_import.import_job([path / "ct.nii"])


# Little to paint.
TANK = plain_settings("jaszczak", voxels=16, rod_diameters=(0,) * 6, sphere_diameters=(30, 0, 0, 0, 0, 0))
VOXELS, RUN = ["voxelizing", "writing the voxels"], ["projecting", "writing the run file", "packing", "storing"]
JOBS = {  # functions of a folder that make jobs, and the stages of each
    "projection": (lambda path: projecting(), ["Projecting", "reading", *RUN]),
    "phantom": (
        lambda path: phantoms.add_phantom_job(TANK, "Body", attenuation=True), ["Making a phantom", *VOXELS],
    ),
    "update": (lambda path: phantoms.update_phantom_job(bpy.data.objects["Derenzo"]), ["Making a phantom", *VOXELS]),
    "import": (importing, ["Importing a volume", "writing the voxels"]),
    "map": (lambda path: maps.map_job(bpy.context.scene, "modules", 8), ["Modules map of 8 modules"]),
    "export": (
        lambda path: scanner_files.export_workbook_job(scanner.active_scanner(bpy.context.scene), path / "own.xlsx"),
        ["Exporting the workbook", "writing the workbook"],
    ),
    "example": (lambda path: example.example_job(bpy.context), ["Loading the example", *VOXELS, *RUN]),
}  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.long) if n == "example" else n for n in JOBS])
def test_cancelling_in_any_stage_leaves_everything_as_it_was(scanned, tmp_path, monkeypatch, name):
    make, all_stages = JOBS[name]
    monkeypatch.setattr(example, "_VOXELS", 8)
    monkeypatch.setattr(example, "_PIXELS", 8)
    before, reached = everything(), []

    def stages(of: str | None):
        def begin(words):
            def progress(done, total):
                if words not in reached:
                    reached.append(words)
                if words == of and done >= total // 2:  # half-way
                    raise Cancelled

            progress(0, 0) if words != of else progress(0, 1)
            return progress

        return begin

    for stage in [words for words in all_stages if words != "storing"]:
        with pytest.raises(Cancelled):
            jobs.run(make(tmp_path), StagedProgress(stages(stage), all_stages[0]))
        assert everything() == before, stage
    if "storing" in all_stages:
        for step in range(3):
            job = make(tmp_path)
            steps = job.finish(job.work(StagedProgress(stages(None), job.label)))
            assert [next(steps) for _ in range(1 + step)][-1] == ("storing", step, 8 if name == "projection" else 80)
            with pytest.raises(Cancelled):
                steps.throw(Cancelled())
            job.discard()
            reached.append("storing")
            assert everything() == before, f"storing {step}"
    assert set(reached) == set(all_stages)


def test_only_what_is_left_unchanged_can_be_stopped(scanned):
    """The last step that can be cancelled is before the first change."""
    job, before = projecting(), everything()
    steps = job.finish(job.work(lambda done, total: None))
    stoppable = []
    for step in steps:
        stoppable.append(step)
    assert stoppable == [*(("storing", k, 8) for k in range(9)), ("storing", 8, 8), None]  # the mosaic is a step
    assert everything() != before
    assert tuple(bpy.data.images["mphDRR 01"].size) == (14, 9)


class Operator(jobs.JobOperator):
    """Stand-in for the operator that Blender makes of a class: `tick` is its timer's event."""

    bl_label = "Test"

    def __init__(self) -> None:
        self.reports = []

    def report(self, kind, text):
        self.reports.append(text)

    def tick(self, kind="TIMER"):
        return self.modal(bpy.context, SimpleNamespace(type=kind, value="PRESS"))


def test_jobs_wait_for_each_other_and_are_cancelled_one_by_one():
    done, discarded = [], []
    go_on = []

    def job(name):
        def work(progress):
            while name not in go_on:
                progress(3, 4)
                time.sleep(0.001)
            return name

        def finish(result):
            yield "storing", 0, 1
            done.append(result)
            yield None
            return f"{name} is done"

        return jobs.Job(name, work, finish, lambda: discarded.append(name))

    a, b, c = operators = [Operator() for _ in range(3)]
    for operator, name in zip(operators, "abc", strict=True):
        operator._enqueue(job(name))
    assert jobs.is_running() and [o._run.is_alive() for o in operators] == [True, False, False]
    assert b.tick() == {"PASS_THROUGH"} and c.tick("ESC") == {"PASS_THROUGH"}, "Esc is for the running one"
    bpy.ops.mphdrr.cancel_job(number=b._run.number)
    assert b.tick() == {"CANCELLED"} and discarded == ["b"] and a._run.is_alive()
    refused(bpy.ops.mphdrr.add_derenzo, "another job is running", voxels=8)
    go_on.append("a")
    a._run.join(5)
    assert c.tick() == {"PASS_THROUGH"} and not c._run.is_alive()
    while a.tick() == {"PASS_THROUGH"}:
        pass
    assert done == ["a"] and a.reports == ["a is done"]
    assert c.tick() == {"PASS_THROUGH"} and c._run.is_alive()
    assert c.tick("ESC") == {"RUNNING_MODAL"}
    c._run.join(5)
    assert c.tick() == {"CANCELLED"} and discarded == ["b", "c"] and "nothing was changed" in c.reports[0]
    assert not jobs.is_running() and done == ["a"]


@pytest.mark.parametrize("step", [0, 1])
def test_cancelling_while_a_job_finishes(step):
    """It stops after a step that can be taken back, and not after another."""
    log = []

    def finish(result):
        try:
            yield "storing", 1, 2
            log.append("changed")
            while len(log) < 2:
                yield None
        except Cancelled:
            log.append("taken back")
            raise
        return "done"

    operator = Operator()
    operator._enqueue(jobs.Job("Test", lambda progress: None, finish))
    operator._run.join(5)
    worker = operator._run
    worker.steps = finish(None)
    for _ in range(1 + step):
        worker.show_step(next(worker.steps))
    bpy.ops.mphdrr.cancel_job()
    if step == 0:
        assert operator.tick() == {"CANCELLED"} and log == ["taken back"]
    else:
        log.append("the rest")
        assert operator.tick() == {"FINISHED"} and log == ["changed", "the rest"]


def test_a_job_says_what_it_does_and_how_long(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(jobs.time, "monotonic", lambda: now[0])
    worker, seen = jobs.Worker("Making", lambda progress: None), []
    project = worker._begin("projecting")
    for seconds, done in ((0.5, 10), (4.5, 20)):
        now[0] += seconds
        project(done, 80)
        seen.append(worker.text)
    now[0] += 9.0
    project(80, 80)
    seen.append(worker.text)
    worker._begin("reconstructing")(120, 320)
    now[0] += 1800.0
    seen.append(worker.text)
    worker._begin("compiling once")
    now[0] += 9.7
    seen.append(worker.text)
    few = ["Projecting 10 of 80", "Projecting 20 of 80, 15 s left", "Projecting 80 of 80"]
    assert seen == [*few, "Reconstructing 38 %, 50 min left", "Compiling once, 10 s"]
    worker.cancel.set()
    assert worker.text == "Compiling once: stopping"
    with pytest.raises(Cancelled):
        project(21, 80)


def test_exact_numbers_take_no_memory_until_they_are_looked_at(scanned):
    image = bpy.data.images[ids.projection_name(1, 8)]
    assert not image.has_data and image.packed_file.size < 16 * 10 * 12
    numbers = images.projection_array(image)
    assert not image.has_data and numbers.max() > 0
    reopened(f"{bpy.app.tempdir}/run.blend")
    assert np.array_equal(images.projection_array(bpy.data.images[ids.projection_name(1, 8)]), numbers)
    assert volumes.volume_objects(bpy.context.scene)


def test_a_run_is_shown_whatever_is_renamed_or_edited_meanwhile(scanned, scene):
    job = projecting()
    result = job.work(lambda done, total: None)
    scene.name, scanner.active_scanner(scene).name = "Another", "Other Ring"
    settings = scene.mphdrr_display
    settings.automatic, settings.low, settings.high = False, 2.0, 1.0  # half typed
    for _ in job.finish(result):
        pass
    made = planes.planes(scene)
    assert settings.problem and len(scene.mphdrr_projections.runs) == 2 and len(made) == 8
    settings.low = 0.5
    assert images.tiles(bpy.data.images[ids.MOSAIC])["window"] == [0.5, 1.0]
