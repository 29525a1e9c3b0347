"""Reconstructions in the scene: a job whose volume is shown, and made anew, while it runs."""

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
from ...core.runs.mosaic import png
from ...core.runs.recipe import recipe_of_tables
from ...core.runs.reconstructing import reconstruct_run, reconstruction_grid, voxels_text
from ...core.runs.run_recipe import truth_of_run
from ...core.volumes.sights import bright_value, full_slices
from ..blender import ids, jobs, objects, storage, windows
from ..pictures import images
from ..runs import rendering, runs
from ..volumes import slices, stored_volumes, volume_materials, volumes

_BETWEEN = 2.0  # s at least between two pictures of a reconstruction that runs
_PNG_LEVEL = 1  # fast
_TEXT = 14.0  # size of text in a picture that fills an editor, pixels at a resolution scale of 1
MORE = 10
"""Iterations that Continue does."""


@dataclass(frozen=True)
class _Shown:
    """What the scene shows of a reconstruction."""

    stored: stored_volumes.StoredVolume
    picture: bytes  # PNG: slices, beside the truth, and the objective
    record: dict[str, Any]  # see `ReconstructionProperties.known`


@dataclass(frozen=True)
class _Last:
    """A reconstruction to go on with."""

    item: int  # its object's `session_uid`
    found: Reconstruction
    stored: stored_volumes.StoredVolume


def resumable(context: bpy.types.Context) -> Path | None:
    """The file from which Continue goes on: of the panel's reconstruction, if it was made by iterations."""
    item = context.scene.mphdrr_reconstruction.volume
    path = None if item is None else storage.resume_file(volumes.file_of(item))
    return path if path is not None and path.is_file() else None


def reconstructing(context: bpy.types.Context, recipe: Recipe) -> jobs.Job:
    """The job that reconstructs the scene's shown run as the [reconstruction] of `recipe` says; raises InputError.

    The volume comes into the scene with the first iteration that is shown. The object of an earlier reconstruction stays.
    """
    run = runs.required_run(context.scene, "reconstruct")
    return _reconstructing(context, recipe, rendering.run_file_path(run.file), run.name)


def continuing(context: bpy.types.Context) -> jobs.Job:
    """The job that does some more iterations of the reconstruction in the panel, in the same object; raises InputError."""
    settings, path = context.scene.mphdrr_reconstruction, resumable(context)
    if path is None:
        raise InputError("nothing to continue: reconstruct first, by iterations")
    item, file, found = settings.volume, settings.known["run"], read_reconstruction(path)
    run = next((run for run in context.scene.mphdrr_projections.runs if storage.absolute(run.file).name == file), None)
    if run is None:
        raise InputError(f"the run that it is of ({file}) has left the list of runs: reconstruct again")
    values, extent = found.volume.array, item.mphdrr_volume.extent
    before = stored_volumes.StoredVolume(
        (found.volume,), volumes.pose_of_object(item), storage.absolute(item.data.filepath),
        float(values.min()), float(values.max()), extent,
    )  # fmt: skip
    recipe = recipe_of_tables(found.settings["recipe"]).updated({"reconstruction.iterations": MORE})
    last = _Last(item.session_uid, found, before)
    return _reconstructing(context, recipe, rendering.run_file_path(run.file), run.name, last)


def _reconstructing(
    context: bpy.types.Context, recipe: Recipe, path: Path, name: str, last: _Last | None = None
) -> jobs.Job:
    scene, folder = context.scene, storage.folder()
    method = method_of(recipe["reconstruction.method"])
    readers, instead = _readers_of_mu(scene), scene.mphdrr_reconstruction.mu
    own_mu = instead.name if instead in volumes.volume_objects(scene) else None
    uid, start = scene.session_uid, time.perf_counter()
    is_watched = windows.has_window()
    if is_watched:
        images.open_editor(context)
    shelf = _Shelf(context, f"{name} {method.label}", last)

    def work(progress: Progress) -> tuple[_Shown, Reconstruction]:
        stages = stages_of(progress)
        stages("reading the run")
        run = read_run(path)
        grid = reconstruction_grid(run, recipe, method)  # refuses what cannot be, before the work begins
        before = 0.0

        def shown_of(
            values: NDArray[Any], objective: Sequence[float], scores: Mapping[str, Any] = {}, flatters: Any = ()
        ) -> _Shown:
            volume = Volume(values, grid, "activity" if run.volume is None else run.volume.quantity)
            record = {
                "title": ", ".join(filter(None, (method.label, iterations_text(len(objective))))),
                "name": method.objective, "objective": list(objective), "voxels": voxels_text(grid),
                "scores": [], "rods": [], "flatters": flatters, **scores, "run": path.name,
            }  # fmt: skip
            picture = _picture(run, volume, record, name, shelf.room)
            stored = stored_volumes.store_volume(volume, folder, None, {"reconstruction_of": name, **recipe.tables()})
            shelf.files.append(stored.path)
            return _Shown(stored, picture, record)

        def watch(iteration: int, values: NDArray[Any], objective: Sequence[float]) -> bool:
            nonlocal before
            if time.monotonic() - before > _BETWEEN and is_watched:
                shelf.latest = shown_of(np.array(values), objective)
                before = time.monotonic()
            return shelf.finish_now.is_set()

        mu = _mu(run, recipe, readers, own_mu)
        found = reconstruct_run(run, recipe, mu, last.found if last else None, watch, stages, method)
        scores = _scores(run, found.volume, stages("scoring"))
        shown = shown_of(found.volume.array, found.objective.tolist(), scores, found.settings["flatters"])
        if found.iterations:
            shelf.files.append(storage.resume_file(shown.stored.path))
            write_reconstruction(found, shelf.files[-1])
        return shown, found

    def finish(result: tuple[_Shown, Reconstruction]) -> str:
        jobs.require_scene(uid, "the reconstruction is")  # or an error
        shown, found = result
        item = shelf.show(shown)
        volumes.make_active(bpy.context, item)
        slices.add_slices(item, full_slices(found.volume.array).tolist())
        images.show_below(bpy.data.images[ids.RECONSTRUCTION], bpy.context)
        shelf.tidy()
        seconds = time.perf_counter() - start
        return f"Reconstructed {item.name!r}: {shown.record['title']}, {shown.record['voxels']}, in {seconds:.1f} s"

    return jobs.Job("Reconstructing", work, finish, shelf.clear, shelf.refresh, shelf.finish_now)


class _Shelf:
    """What a running reconstruction has put into the scene and on the disk, to be replaced, or taken back."""

    def __init__(self, context: bpy.types.Context, name: str, last: _Last | None) -> None:
        self.name, self.finish_now, self._last = name, threading.Event(), last
        self.files: list[Path] = []
        self.latest: _Shown | None = None  # made by the thread
        self.room = images.editor_size(context) if windows.has_window() else None  # that the picture fills
        scene = context.scene
        settings = scene.mphdrr_reconstruction
        self._scene, self._item, self._is_shown = scene.session_uid, last.item if last else 0, False
        self._hidden: list[int] = []  # the truth, and an earlier reconstruction
        self._before = settings.volume, settings.record
        image = bpy.data.images.get(ids.RECONSTRUCTION)
        packed = None if image is None else image.packed_file
        self._picture = None if packed is None else bytes(packed.data)

    def refresh(self) -> None:
        """Show what the thread has made since."""
        self.room = images.editor_size(bpy.context)
        latest, self.latest = self.latest, None
        if latest is not None:
            is_first = not self._is_shown
            self.show(latest)
            if is_first:
                images.show_below(bpy.data.images[ids.RECONSTRUCTION], bpy.context)

    def show(self, shown: _Shown) -> bpy.types.Object:
        """Put a state of the reconstruction into the scene, in place of the one before."""
        scene = jobs.find_by_uid(bpy.data.scenes, self._scene)
        item = jobs.find_by_uid(bpy.data.objects, self._item)
        if not self._is_shown:
            self._is_shown = True
            self._hide(runs.projected_volume(scene), scene.mphdrr_reconstruction.volume if item is None else None)
        if item is None:  # or the user has deleted it
            item = volumes.add_stored(shown.stored, self.name, scene.collection)
            self._item = item.session_uid
        else:
            volumes.replace_stored(item, shown.stored)
        factor = volume_materials.display_unit(item.mphdrr_volume.quantity)[1]
        bright = factor * bright_value(shown.stored.volume.array)
        if bright > 0:  # the hottest voxel does not say how bright the others are
            item.mphdrr_volume.display_high = bright
        images.store_png(ids.RECONSTRUCTION, shown.picture)
        settings = scene.mphdrr_reconstruction
        settings.volume, settings.record = item, json.dumps(shown.record)
        return item

    def _hide(self, *items: bpy.types.Object | None) -> None:
        """Hide what stands where the reconstruction is; the eye beside its name brings it back."""
        for item in items:
            if item is not None and item.name in bpy.context.view_layer.objects and not item.hide_get():
                item.hide_set(True)
                self._hidden.append(item.session_uid)

    def tidy(self) -> None:
        """Remove the files of states that are not shown any more."""
        unused = set(storage.unused_volumes())
        for path in self.files:
            if path in unused:
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Take everything back."""
        item = jobs.find_by_uid(bpy.data.objects, self._item)
        for hidden in filter(None, (jobs.find_by_uid(bpy.data.objects, uid) for uid in self._hidden)):
            hidden.hide_set(False)
        if item is not None and self._last is not None:
            volumes.replace_stored(item, self._last.stored)
        elif item is not None:
            materials = list(item.data.materials)
            objects.remove_objects([item, *item.children])
            objects.remove_unused(materials)
        scene = jobs.find_by_uid(bpy.data.scenes, self._scene)
        if scene is not None and self._is_shown:
            settings = scene.mphdrr_reconstruction
            with suppress(ReferenceError):
                settings.volume, settings.record = self._before
            image = bpy.data.images.get(ids.RECONSTRUCTION)
            if self._picture is not None:
                images.store_png(ids.RECONSTRUCTION, self._picture)
            elif image is not None:
                bpy.data.images.remove(image)
        self.tidy()


def _scores(run: ProjectionRun, volume: Volume, progress: Progress | None) -> dict[str, Any]:
    """The scores beside the truth as the panel shows them; none of a measured run.

    They are names and values in words; of rods their size, light, valley/peak, or why there is none, and contrast.
    """
    if run.volume is None:
        return {}
    try:
        score = score_volume(volume, *truth_of_run(run), progress)
    except InputError as error:  # such as a truth that is the same everywhere: the reconstruction is worth keeping
        return {"scores": [("No score", str(error))]}
    lines = [("NRMSE", f"{score.nrmse:.3g}")]
    for sphere in score.nema or ():
        score_text = f"{sphere.contrast_recovery:.1f} % contrast, {sphere.background_variability:.1f} % variability"
        lines.append((f"{sphere.diameter:g} mm sphere", score_text))
    return {"scores": lines, "rods": [sector.cells for sector in score.derenzo or () if sector.rod_diameter]}


def _picture(
    run: ProjectionRun, volume: Volume, record: dict[str, Any], name: str, room: tuple[int, int, float] | None
) -> bytes:
    """A picture that fills its editor's room, if there is one: width and height, pixels, and Blender's scale of texts."""
    page = Page(*(SIZE if run.volume is None else SIZE_BESIDE_TRUTH), DARK)
    if room is not None and min(room[:2]) >= SMALLEST:
        page = Page(*room[:2], DARK, _TEXT * room[2])
    line = ", ".join([record["title"], *map(" ".join, record["scores"][:1]), record["voxels"]])
    lines, title = [line, *record["flatters"]], f"Reconstruction of {name}"
    draw(page, volume, record["objective"], run.volume, title, lines, record["name"], record["rods"])
    return png(page.picture, _PNG_LEVEL)


def _readers_of_mu(scene: bpy.types.Scene) -> dict[str, Callable[[], Volume]]:
    """What reads each attenuation of the scene, by its object's name, in a thread."""
    found = {}
    for item in volumes.volume_objects(scene):
        if volumes.quantity_of(item) in ("mu", "hu"):
            with suppress(InputError):  # its file is gone; another one may be meant
                found[item.name] = volumes.reader(item)
    return found


def _mu(
    run: ProjectionRun, recipe: Recipe, readers: Mapping[str, Callable[[], Volume]], instead: str | None
) -> Volume | None:
    """The attenuation `instead` of the run's, or of a run's object of the scene; None of others, which the run knows."""
    name = run.recipe["attenuation.object"] if instead is None else instead
    if name is None or run.recipe["model.kind"] != "emission" or recipe["reconstruction.ignore_attenuation"]:
        return None
    if name not in readers:
        raise InputError(
            f"the run's attenuation {name!r} is not in the scene any more: choose Ignore Attenuation, or render"
        )
    return readers[name]()
