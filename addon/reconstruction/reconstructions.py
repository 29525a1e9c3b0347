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

from ...core import InputError, ProjectionRun, Recipe, Volume, read_run, score_volume
from ...core.figures.page import Page
from ...core.figures.reconstructions import SIZE, SIZE_BESIDE_TRUTH, draw
from ...core.progress import Progress, stages_of
from ...core.reconstruction.methods import method_of
from ...core.reconstruction.result import iterations_text
from ...core.runs.mosaic import png
from ...core.runs.reconstructing import reconstruct_run, reconstruction_grid
from ...core.runs.run_recipe import truth_of_run
from ..blender import ids, jobs, objects, plots, storage, windows
from ..pictures import images
from ..runs import rendering, runs
from ..volumes import stored_volumes, volumes

_BETWEEN = 2.0  # s at least between two pictures of a reconstruction that runs
_PNG_LEVEL = 1  # fast


@dataclass(frozen=True)
class _Shown:
    """What the scene shows of a reconstruction."""

    stored: stored_volumes.StoredVolume
    picture: bytes  # PNG: slices, beside the truth, and the objective
    record: dict[str, Any]  # see `ReconstructionProperties.known`


def reconstructing(context: bpy.types.Context, recipe: Recipe) -> jobs.Job:
    """The job that reconstructs the scene's shown run as the [reconstruction] of `recipe` says; raises InputError.

    The volume comes into the scene with the first iteration that is shown. The object of an earlier reconstruction stays.
    """
    scene, shown = context.scene, runs.required(context.scene, "reconstruct")
    path, name, folder = rendering.file_of(shown.file), shown.name, storage.folder()
    method = method_of(recipe["reconstruction.method"])
    readers = _readers_of_mu(scene)
    uid, start = scene.session_uid, time.perf_counter()
    is_watched = windows.has_window()
    shelf = _Shelf(scene, f"{name} {method.label}")

    def work(progress: Progress) -> _Shown:
        stages = stages_of(progress)
        stages("reading the run")
        run = read_run(path)
        grid = reconstruction_grid(run, recipe, method)  # refuses what cannot be, before the work begins
        last = 0.0

        def shown_of(values: NDArray[Any], objective: Sequence[float], scores: Any = (), flatters: Any = ()) -> _Shown:
            volume = Volume(values, grid, "activity" if run.volume is None else run.volume.quantity)
            record = {
                "title": ", ".join(filter(None, (method.label, iterations_text(len(objective))))),
                "name": method.objective, "objective": list(objective), "scores": list(scores), "flatters": flatters,
                "run": path.name,
            }  # fmt: skip
            picture = _picture(run, volume, record, name)
            stored = stored_volumes.store_volume(volume, folder, None, {"reconstruction_of": name, **recipe.tables()})
            shelf.files.append(stored.path)
            return _Shown(stored, picture, record)

        def watch(iteration: int, values: NDArray[Any], objective: Sequence[float]) -> bool:
            nonlocal last
            if time.monotonic() - last > _BETWEEN and is_watched:
                shelf.latest = shown_of(np.array(values), objective)
                last = time.monotonic()
            return shelf.enough.is_set()

        found = reconstruct_run(run, recipe, _mu(run, recipe, readers), watch=watch, stages=stages, method=method)
        scores = _scores(run, found.volume, stages("scoring"))
        return shown_of(found.volume.array, found.objective.tolist(), scores, found.settings["flatters"])

    def finish(result: _Shown) -> str:
        jobs.scene_again(uid, "the reconstruction is")  # or an error
        item = shelf.show(result)
        volumes.make_active(bpy.context, item)
        images.show_below(bpy.data.images[ids.RECONSTRUCTION], bpy.context)
        shelf.tidy()
        seconds = time.perf_counter() - start
        return f"Reconstructed {item.name!r}: {result.record['title']}, in {seconds:.1f} s"

    return jobs.Job("Reconstructing", work, finish, shelf.clear, shelf.look, shelf.enough)


class _Shelf:
    """What a running reconstruction has put into the scene and on the disk, to be replaced, or taken back."""

    def __init__(self, scene: bpy.types.Scene, name: str) -> None:
        self.name, self.enough = name, threading.Event()
        self.files: list[Path] = []
        self.latest: _Shown | None = None  # made by the thread
        settings = scene.mphdrr_reconstruction
        self._scene, self._item = scene.session_uid, 0
        self._before = settings.volume, settings.record
        image = bpy.data.images.get(ids.RECONSTRUCTION)
        packed = None if image is None else image.packed_file
        self._picture = None if packed is None else bytes(packed.data)

    def look(self) -> None:
        """Show what the thread has made since."""
        latest, self.latest = self.latest, None
        if latest is not None:
            is_first = not self._item
            self.show(latest)
            if is_first:
                images.show_below(bpy.data.images[ids.RECONSTRUCTION], bpy.context)

    def show(self, shown: _Shown) -> bpy.types.Object:
        """Put a state of the reconstruction into the scene, in place of the one before."""
        scene = jobs.found_again(bpy.data.scenes, self._scene)
        item = jobs.found_again(bpy.data.objects, self._item)
        if item is None:  # or the user has deleted it
            item = volumes.add_stored(shown.stored, self.name, scene.collection)
            self._item = item.session_uid
        else:
            volumes.replace_stored(item, shown.stored)
        images.store_drawn(ids.RECONSTRUCTION, shown.picture)
        settings = scene.mphdrr_reconstruction
        settings.volume, settings.record = item, json.dumps(shown.record)
        plots.forget()
        return item

    def tidy(self) -> None:
        """Remove the files of states that are not shown any more."""
        unused = set(storage.unused_volumes())
        for path in self.files:
            if path in unused:
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Take everything back."""
        item = jobs.found_again(bpy.data.objects, self._item)
        if item is not None:
            materials = list(item.data.materials)
            objects.remove_objects([item, *item.children])
            objects.remove_unused(materials)
        scene = jobs.found_again(bpy.data.scenes, self._scene)
        if scene is not None and self._item:
            settings = scene.mphdrr_reconstruction
            with suppress(ReferenceError):
                settings.volume, settings.record = self._before
            image = bpy.data.images.get(ids.RECONSTRUCTION)
            if self._picture is not None:
                images.store_drawn(ids.RECONSTRUCTION, self._picture)
            elif image is not None:
                bpy.data.images.remove(image)
            plots.forget()
        self.tidy()


def _picture(run: ProjectionRun, volume: Volume, record: dict[str, Any], name: str) -> bytes:
    page = Page(*(SIZE if run.volume is None else SIZE_BESIDE_TRUTH))
    line = ", ".join([record["title"], *map(": ".join, record["scores"][:1])])
    lines = [line, *record["flatters"]]
    draw(page, volume, record["objective"], run.volume, f"Reconstruction of {name}", lines, record["name"])
    return png(page.picture, _PNG_LEVEL)


def _scores(run: ProjectionRun, volume: Volume, progress: Progress | None) -> list[tuple[str, str]]:
    """The scores beside the truth, as names and values in words; none of a measured run."""
    if run.volume is None:
        return []
    truth, pose = truth_of_run(run)
    try:
        score = score_volume(volume, truth, pose, progress)
    except InputError as error:  # such as a truth that is the same everywhere: the reconstruction is worth keeping
        return [("No score", str(error))]
    lines = [("NRMSE", f"{score.nrmse:.3g}")]
    for rods in score.derenzo or ():
        lines.append((f"{rods.rod_diameter:g} mm rods", rods.words))
    for sphere in score.nema or ():
        score_text = f"{sphere.contrast_recovery:.1f} % contrast, {sphere.background_variability:.1f} % variability"
        lines.append((f"{sphere.diameter:g} mm sphere", score_text))
    return lines


def _readers_of_mu(scene: bpy.types.Scene) -> dict[str, Callable[[], Volume]]:
    """What reads each attenuation of the scene, by its object's name, in a thread."""
    found = {}
    for item in volumes.volume_objects(scene):
        if volumes.quantity_of(item) in ("mu", "hu"):
            with suppress(InputError):  # its file is gone; another one may be meant
                found[item.name] = volumes.reader(item)
    return found


def _mu(run: ProjectionRun, recipe: Recipe, readers: Mapping[str, Callable[[], Volume]]) -> Volume | None:
    """The attenuation of a run that was an object of the scene; None of others, which the run itself knows."""
    name = run.recipe["attenuation.object"]
    if name is None or recipe["reconstruction.ignore_attenuation"]:
        return None
    if name not in readers:
        raise InputError(
            f"the run's attenuation {name!r} is not in the scene any more: choose Ignore Attenuation, or render"
        )
    return readers[name]()
