"""Reconstructions in the scene: jobs whose volume is shown, and updated, while they run."""

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import (
    InputError,
    ProjectionRun,
    Recipe,
    Reconstruction,
    Volume,
    read_reconstruction,
    read_run,
    score_volume,
    write_reconstruction,
)
from ...core.figures.page import DARK, SMALLEST, Page
from ...core.figures.reconstructions import SIZE, SIZE_BESIDE_TRUTH, draw
from ...core.progress import Progress, stages_of
from ...core.reconstruction.methods import method_of
from ...core.reconstruction.result import iterations_text
from ...core.runs.mosaic import png_bytes
from ...core.runs.recipe import recipe_from_tables
from ...core.runs.reconstructing import reconstruct_run, reconstruction_grid, voxels_text
from ...core.runs.run_recipe import run_truth
from ...core.volumes.sights import full_slices
from ..blender import ids, jobs, objects, storage, windows
from ..pictures import images, planes
from ..runs import rendering, runs
from ..volumes import looks, slices, stored_volumes, volumes

_MIN_INTERVAL = 2.0  # s between two pictures of a running reconstruction
_PNG_LEVEL = 1  # fast compression
_SURFACE = 0.4  # value of the rods' surface, as a share of the display range, which begins at 0
_TEXT = 14.0  # size of text in a picture that fills an editor, pixels at a resolution scale of 1
MORE_ITERATIONS = 10
"""Number of iterations that Continue does."""


@dataclass(frozen=True)
class _ShownState:
    """Contents of the scene for a reconstruction, running or finished: stored volume, picture of its slices, and record."""

    stored: stored_volumes.StoredVolume
    picture: bytes  # PNG of slices, beside the truth if there is one, and the objective
    window: tuple[float, float]  # values of the slices' first and last colours
    record: dict[str, Any]  # see `ReconstructionProperties.details`


@dataclass(frozen=True)
class _PreviousResult:
    """Reconstruction to be continued."""

    item: int  # `session_uid` of its object
    reconstruction: Reconstruction
    stored: stored_volumes.StoredVolume


def resume_path(context: bpy.types.Context) -> Path | None:
    """Return the file from which Continue goes on, for the panel's reconstruction; None if it was not made by iterations."""
    item = context.scene.mphdrr_reconstruction.volume
    path = None if item is None else storage.resume_file(volumes.file_of(item))
    return path if path is not None and path.is_file() else None


def reconstruct_job(context: bpy.types.Context, recipe: Recipe) -> jobs.Job:
    """Return the job that reconstructs the scene's shown run by the table [reconstruction] of `recipe`; raise `InputError`.

    The volume appears in the scene with the first iteration that is shown. The object of an earlier reconstruction stays.
    """
    run = runs.required_run(context.scene, "reconstruct")
    return _make_job(context, recipe, rendering.run_file_path(run.file), runs.subject_of(run))


def continue_job(context: bpy.types.Context) -> jobs.Job:
    """Return the job that does further iterations of the panel's reconstruction, in the same object; raise `InputError`."""
    settings, path = context.scene.mphdrr_reconstruction, resume_path(context)
    if path is None:
        raise InputError("nothing to continue: reconstruct first, by iterations")
    item, file, reconstruction = settings.volume, settings.details["run"], read_reconstruction(path)
    run = next((run for run in context.scene.mphdrr_projections.runs if storage.absolute(run.file).name == file), None)
    if run is None:
        raise InputError(f"the run that it is of ({file}) has left the list of runs: reconstruct again")
    values, extent = reconstruction.volume.array, item.mphdrr_volume.extent
    stored = stored_volumes.StoredVolume((reconstruction.volume,), volumes.pose_of_object(item),
                                         storage.absolute(item.data.filepath), float(values.min()), float(values.max()),
                                         extent)  # fmt: skip
    recipe = recipe_from_tables(reconstruction.settings["recipe"])
    recipe = recipe.updated({"reconstruction.iterations": MORE_ITERATIONS})
    previous = _PreviousResult(item.session_uid, reconstruction, stored)
    return _make_job(context, recipe, rendering.run_file_path(run.file), runs.subject_of(run), previous)


def _make_job(
    context: bpy.types.Context, recipe: Recipe, path: Path, name: str, previous: _PreviousResult | None = None
) -> jobs.Job:
    """Return the job that reconstructs the run in the file `path`, from the start or on from a previous result."""
    scene, folder = context.scene, storage.folder()
    method = method_of(recipe["reconstruction.method"])
    readers, panel_mu = _mu_readers(scene), scene.mphdrr_reconstruction.mu
    mu_name = panel_mu.name if panel_mu in volumes.volume_objects(scene) else None
    uid, start = scene.session_uid, time.perf_counter()
    if has_window := windows.has_window():
        images.open_editor(context)
    live = _LiveResult(context, f"{name} {method.label}", previous)

    def work(progress: Progress) -> tuple[_ShownState, Reconstruction]:
        """Reconstruct the run; return the last state to show and the reconstruction."""
        stages = stages_of(progress)
        stages("reading the run")
        run = read_run(path)
        grid = reconstruction_grid(run, recipe, method)  # raises its errors before the work begins
        last_shown = 0.0

        def make_state(
            values: NDArray[Any], objective: Sequence[float], scores: Mapping[str, Any] = {}, flatters: Any = ()
        ) -> _ShownState:
            """Store a volume with its picture and record, to be shown in the scene."""
            volume = Volume(values, grid, "activity" if run.volume is None else run.volume.quantity)
            record = {
                "title": ", ".join(filter(None, (method.label, iterations_text(len(objective))))),
                "name": method.objective, "objective": list(objective), "voxels": voxels_text(grid),
                "scores": [], "rods": [], "flatters": flatters, **scores, "run": path.name,
            }  # fmt: skip
            picture, window = _draw_picture(run, volume, record, name, live.editor_size)
            stored = stored_volumes.store_volume(volume, folder, None, {"reconstruction_of": name, **recipe.tables()})
            live.files.append(stored.path)
            return _ShownState(stored, picture, window, record)

        def watch(iteration: int, values: NDArray[Any], objective: Sequence[float]) -> bool:
            """Make the volume of an iteration ready to be shown, at most every few seconds; return whether to stop."""
            nonlocal last_shown
            if time.monotonic() - last_shown > _MIN_INTERVAL and has_window:
                live.unshown = make_state(np.array(values), objective)
                last_shown = time.monotonic()
            return live.finish_now.is_set()

        mu = _read_mu(run, recipe, readers, mu_name)
        old_result = previous.reconstruction if previous else None
        result = reconstruct_run(run, recipe, mu, old_result, watch, stages, method)
        scores = _scores(run, result.volume, stages("scoring"))
        state = make_state(result.volume.array, result.objective.tolist(), scores, result.settings["flatters"])
        if result.iterations:
            live.files.append(storage.resume_file(state.stored.path))
            write_reconstruction(result, live.files[-1])
        return state, result

    def finish(result: tuple[_ShownState, Reconstruction]) -> str:
        """Show the final volume and its scores, and return the line to report."""
        jobs.require_scene(uid, "the reconstruction is")
        state, reconstruction = result
        item = live.show(state)
        volumes.make_active(bpy.context, item)
        item.select_set(False)  # its box would stand around the rods
        slices.add_slices(item, full_slices(reconstruction.volume.array).tolist())
        images.show_below(bpy.data.images[ids.RECONSTRUCTION], bpy.context)
        storage.remove_results(live.files)
        seconds = time.perf_counter() - start
        return f"Reconstructed {item.name!r}: {state.record['title']}, {state.record['voxels']}, in {seconds:.1f} s"

    return jobs.Job("Reconstructing", work, finish, live.clear, live.refresh, live.finish_now)


class _LiveResult:
    """Scene objects and files of a running reconstruction; updated after iterations, removed if the user cancels."""

    def __init__(self, context: bpy.types.Context, name: str, previous: _PreviousResult | None) -> None:
        self.name, self.finish_now, self._previous = name, threading.Event(), previous
        self.files: list[Path] = []
        self.unshown: _ShownState | None = None  # latest state of the worker thread, which is not shown yet
        self.editor_size = images.editor_size(context) if windows.has_window() else None  # room for the picture
        scene = context.scene
        settings = scene.mphdrr_reconstruction
        self._scene, self._item, self._is_shown = scene.session_uid, previous.item if previous else 0, False
        self._hidden: list[int] = []  # `session_uid` of hidden objects: the truth, an earlier reconstruction
        self._old_record = settings.volume, settings.record
        image = bpy.data.images.get(ids.RECONSTRUCTION)
        packed = None if image is None else image.packed_file
        self._old_picture = None if packed is None else bytes(packed.data)

    def refresh(self) -> None:
        """Show the latest state of the worker thread."""
        self.editor_size = images.editor_size(bpy.context)
        state, self.unshown = self.unshown, None
        if state is not None:
            is_first = not self._is_shown
            self.show(state)
            if is_first:
                images.show_below(bpy.data.images[ids.RECONSTRUCTION], bpy.context)

    def show(self, state: _ShownState) -> bpy.types.Object:
        """Put a state of the reconstruction into the scene, in place of the previous one, and return its object."""
        scene = jobs.find_by_uid(bpy.data.scenes, self._scene)
        item = jobs.find_by_uid(bpy.data.objects, self._item)
        if not self._is_shown:
            self._is_shown = True
            old = scene.mphdrr_reconstruction.volume if item is None else None
            self._hidden = objects.hide(runs.projected_volume(scene), old, *planes.planes(scene))
        if item is None:  # first state, or the user has deleted the object
            item = volumes.add_stored(state.stored, self.name, scene.collection)
            self._item = item.session_uid
            if item.mphdrr_volume.quantity == "activity":
                item.mphdrr_volume.look = "SHELL"
                item.mphdrr_volume.surface = _SURFACE * item.mphdrr_volume.display_high
        else:
            volumes.replace_stored(item, state.stored)
        if state.window[0] < state.window[1]:
            volumes.set_display_range(item, *state.window)
        images.store_png(ids.RECONSTRUCTION, state.picture)
        settings = scene.mphdrr_reconstruction
        settings.volume, settings.record = item, json.dumps(state.record)
        return item

    def clear(self) -> None:
        """Restore scene and files as they were before the job."""
        item = jobs.find_by_uid(bpy.data.objects, self._item)
        for hidden in filter(None, (jobs.find_by_uid(bpy.data.objects, uid) for uid in self._hidden)):
            hidden.hide_set(False)
        if item is not None and self._previous is not None:
            volumes.replace_stored(item, self._previous.stored)
        elif item is not None:
            materials = list(item.data.materials)
            looks.remove_surface(item)
            objects.remove_objects([item, *item.children])
            objects.remove_unused(materials)
        scene = jobs.find_by_uid(bpy.data.scenes, self._scene)
        if scene is not None and self._is_shown:
            settings = scene.mphdrr_reconstruction
            with suppress(ReferenceError):
                settings.volume, settings.record = self._old_record
            image = bpy.data.images.get(ids.RECONSTRUCTION)
            if self._old_picture is not None:
                images.store_png(ids.RECONSTRUCTION, self._old_picture)
            elif image is not None:
                bpy.data.images.remove(image)
        storage.remove_results(self.files)


def _scores(run: ProjectionRun, volume: Volume, progress: Progress | None) -> dict[str, Any]:
    """Return the scores beside the truth as the panel shows them; none of a measured run.

    They are names and values in words; of rods their size, light, valley/peak, or why there is none, and contrast.
    """
    if run.volume is None:
        return {}
    try:
        score = score_volume(volume, *run_truth(run), progress)
    except InputError as error:  # such as a truth that is the same everywhere: the reconstruction is worth keeping
        return {"scores": [("No score", str(error))]}
    return {"scores": score.cells, "rods": [sector.cells for sector in score.derenzo or () if sector.rod_diameter]}


def _draw_picture(
    run: ProjectionRun, volume: Volume, record: dict[str, Any], name: str, editor_size: tuple[int, int, float] | None
) -> tuple[bytes, tuple[float, float]]:
    """Return a PNG of slices and objective that fills an editor, and the values of the slices' first and last colours.

    `editor_size` is the editor's width and height, pixels, and Blender's scale of texts.
    """
    page = Page(*(SIZE if run.volume is None else SIZE_BESIDE_TRUTH), DARK)
    if editor_size is not None and min(editor_size[:2]) >= SMALLEST:
        page = Page(*editor_size[:2], DARK, _TEXT * editor_size[2])
    line = ", ".join([record["title"], *map(" ".join, record["scores"][:1]), record["voxels"]])
    lines, title = [line, *record["flatters"]], f"Reconstruction of {name}"
    window = draw(page, volume, record["objective"], run.volume, title, lines, record["name"], record["rods"])
    return png_bytes(page.picture, _PNG_LEVEL), window


def _mu_readers(scene: bpy.types.Scene) -> dict[str, Callable[[], Volume]]:
    """Return a function that reads each attenuation of the scene in a worker thread, by its object's name."""
    readers = {}
    for item in volumes.volume_objects(scene):
        if volumes.quantity_of(item) in ("mu", "hu"):
            with suppress(InputError):  # its file is gone, but another attenuation may be needed
                readers[item.name] = volumes.reader(item)
    return readers


def _read_mu(
    run: ProjectionRun, recipe: Recipe, readers: Mapping[str, Callable[[], Volume]], mu_name: str | None
) -> Volume | None:
    """Return the attenuation `mu_name`, by default that of the run's recipe, if it is an object of the scene; else None."""
    name = run.recipe["attenuation.object"] if mu_name is None else mu_name
    if name is None or run.recipe["model.kind"] != "emission" or recipe["reconstruction.ignore_attenuation"]:
        return None
    if name not in readers:
        advice = "choose Ignore Attenuation, or render"
        raise InputError(f"the run's attenuation {name!r} is not in the scene any more: {advice}")
    return readers[name]()
