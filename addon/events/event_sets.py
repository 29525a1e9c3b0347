"""Event sets in the window: a recipe tried on the phantom in the scene, a set made, an event opened in the scene."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...core import InputError, ProjectionRun, events, memory
from ...core.cli.options import count_text
from ...core.events.folders import SetFolder
from ...core.events.templates import template_text
from ...core.example import EXAMPLE
from ...core.files import write_bytes
from ...core.progress import Progress, stages_of
from ..blender import jobs, objects, storage
from ..figures import studio
from ..phantoms import phantom_properties, phantoms
from ..pictures import images
from ..runs import rendering, runs
from ..scanner import scanner
from ..volumes import stored_volumes, volumes

_MAX_VOXELS = 128
"""Largest number of voxels along each side of a phantom, unless the phantom in the scene has another number."""


@dataclass(frozen=True)
class _Target:
    """Phantom in the scene that will become an event's phantom, described for a worker thread."""

    uid: int = 0  # `session_uid` of its object; 0: there is none yet
    other_quantities: tuple[str, ...] = ()  # quantities of its other volumes
    voxels: int = 0  # number along each side; 0: the recipe's


@dataclass(frozen=True)
class _Phantom:
    """An event's phantom with its voxels in files."""

    stored: list[stored_volumes.StoredVolume]
    settings: phantom_properties.KindSettings | None  # None for a phantom from a file
    placement: NDArray[np.float64]  # world from object (4, 4), mm


def write_recipe(scene: bpy.types.Scene, filepath: str, template: str) -> str:
    """Write a recipe from one of `TEMPLATES`, with the scene's or the example's workbook, and choose it in the panel."""
    if not filepath:
        raise InputError("no file given: set filepath to a name ending in .toml")
    path = storage.absolute(filepath)
    collection = scanner.active_scanner(scene)
    scanner_workbook = collection.mphdrr_scanner.workbook if collection is not None else ""
    workbook = storage.absolute(scanner_workbook) if scanner_workbook else EXAMPLE
    is_near = workbook.is_relative_to(path.parent)
    text = template_text(template, workbook.relative_to(path.parent).as_posix() if is_near else workbook)
    write_bytes(path, text.encode())
    scene.mphdrr_events.recipe = storage.stored_path(path)
    return f"Wrote {path}, of {workbook.name}: edit it in any text editor"


def try_event_job(context: bpy.types.Context, filepath: str, number: int, folder: str = "") -> jobs.Job:
    """Return the job that makes the scene's phantom that of event `number` of a recipe, and increases the panel's number.

    Without a recipe's file it takes the recipe of the set in `folder`. The phantom is the active one, else the one tried
    last, else the scene's only one, else a new one. Its object is placed with the event's mirroring and size; a factor of
    activity enters its settings. Raises InputError.
    """
    read, scene, files = _recipe_reader(filepath, folder), context.scene, storage.folder()
    target, uid = _make_target(_phantom_to_try(context)), scene.session_uid

    def work(progress: Progress) -> tuple[_Phantom, str]:
        """Store the voxels of the event's phantom; return it with a description of the event."""
        planned = events.plan(read(), number)
        return _store_phantom(planned, target, files, progress), _describe(planned)

    def finish(result: tuple[_Phantom, str]) -> str:
        """Put the phantom into the scene, and return the line to report."""
        phantom, text = result
        scene = jobs.require_scene(uid, "the event is")
        settings = scene.mphdrr_events
        item = _place_phantom(scene, phantom, target)
        settings.phantom, settings.tried, settings.number = item, text, number + 1
        _select(item, settings.truth)
        return f"{item.name!r} is now the phantom of {text}"

    return jobs.Job("Trying an event", work, finish)


def make_set_job(filepath: str, folder: str, count: int) -> jobs.Job:
    """Return the job that makes the first `count` events of a recipe in a set's folder, except those that it has already.

    Without a recipe's file it takes the folder's own recipe. Events made before the user cancels stay. Raises InputError.
    """
    if not folder:
        raise InputError("no folder given: choose a new one for the event set, or that of a set to go on with")
    read, path = _recipe_reader(filepath, folder), storage.absolute(folder)
    new_events: list[events.Made] = []

    def work(progress: Progress) -> float:
        """Make the missing events, and return the seconds that it took."""
        start = time.perf_counter()
        report = stages_of(progress)("making events") or progress

        def step(done: int, steps: int) -> None:
            """Report the number of finished events between the steps of an event, and stop where the user has cancelled."""
            report(len(new_events), new_events[-1].total if new_events else 0)

        for event in events.making(read(), path, count, progress=step):
            new_events.append(event)
            step(0, 0)
        return time.perf_counter() - start

    def finish(seconds: float) -> str:
        """Return the line to report: the number, size and folder of the events that were made."""
        n_events = len(SetFolder(path).store.locations())
        if not new_events:
            return f"All events asked for are there already: {n_events} in {path}"
        size = memory.readable_size(sum(event.size for event in new_events))
        return f"Made {count_text(len(new_events), 'event')}, {size} in {seconds:.1f} s: {n_events} in {path}"

    def leftovers() -> str:
        """Return the line for a cancelled job: the number of events that were made and stay."""
        return f"{count_text(len(new_events), 'event')} made now and kept; Make Event Set goes on from there"

    return jobs.Job("Making an event set", work, finish, leftovers=leftovers)


@dataclass(frozen=True)
class _StoredEvent:
    """An event with its voxels in files, ready to be put into the scene."""

    name: str
    text: str
    truth: stored_volumes.StoredVolume
    phantom: _Phantom | None  # None for an event made from a volume's file, which has only the truth
    run: ProjectionRun | None
    pictures: images.Pictures | None


def open_event_job(context: bpy.types.Context, folder: str, number: int, model: str = "") -> jobs.Job:
    """Return the job that puts an event of the set in a folder into the scene, in place of the one opened before.

    Its truth is a volume whose object has the event's pose; its phantom is hidden. The projections of a model, by default
    the first, become a run, of the set's scanner where the scene has none. Raises InputError.
    """
    if not folder:
        raise InputError("no folder given: choose that of an event set")
    scene, path, files = context.scene, storage.absolute(folder), storage.folder()
    target, truth_uid = _make_target(_item(scene, "phantom")), getattr(_item(scene, "truth"), "session_uid", 0)
    run_file, display, uid = rendering.new_run_path(scene), scene.mphdrr_display.display(), scene.session_uid

    def work(progress: Progress) -> _StoredEvent:
        """Read the event, and store its voxels, its run and the run's pictures."""
        stages = stages_of(progress)
        stages("reading the event")
        event = _read_event(path, number)
        name, planned = f"Event {number} {event.name}", event.planned
        stages("writing the voxels")
        truth = stored_volumes.store_volume(event.truth, files, event.placement, {"event": number, "set": str(path)})
        phantom = None if planned.entry.kind is None else _store_phantom(planned, target, files, progress)
        if not (models := planned.recipe.models):
            return _StoredEvent(name, _describe(planned), truth, phantom, None, None)
        run = event.run(model or next(iter(models)))
        run = replace(run, settings={**run.settings, "volume": name})
        pictures = rendering.write_and_draw(run, run_file, display, stages)
        return _StoredEvent(name, _describe(planned), truth, phantom, run, pictures)

    def finish(stored_event: _StoredEvent) -> jobs.Finishing:
        """Put the truth, the phantom and the run of the event into the scene, and return the line to report."""
        run, mosaic = stored_event.run, None
        if run is not None and stored_event.pictures is not None:
            mosaic = yield from images.store_images(run, stored_event.pictures)
        scene = jobs.require_scene(uid, "the event is")
        settings = scene.mphdrr_events
        collection = scanner.active_scanner(scene)
        if run is not None and collection is None:
            collection = scanner.build_scanner(scene, run.system)
            studio.light(scene)
            yield None
        if stored_event.phantom is not None:
            settings.phantom = _place_phantom(scene, stored_event.phantom, target)
            yield None
        if (item := jobs.find_by_uid(bpy.data.objects, truth_uid)) is None:
            item = volumes.add_stored(stored_event.truth, stored_event.name, scene.collection)
        else:
            volumes.replace_stored(item, stored_event.truth)
            item.name = stored_event.name
        settings.truth, settings.tried = item, stored_event.text
        _select(item, settings.phantom)
        yield None
        if run is not None:
            rendering.show_planes(scene, run, collection)
            runs.add_run(scene, run, run_file, rendering.adopt_settings(scene, run, item), collection)
            images.show_below(mosaic, bpy.context)
        return f"Opened {stored_event.text}" + ("" if run is not None else "; it has no projections of a model")

    return jobs.Job("Opening an event", work, finish, lambda: run_file.unlink(missing_ok=True))


def _recipe_reader(filepath: str, folder: str) -> Callable[[], events.EventRecipe]:
    """Return a function, for a worker thread, that reads the recipe file, or the recipe stored in the set.

    `InputError` where neither is given.
    """
    if filepath:
        path = storage.absolute(filepath)
        return lambda: events.read_recipe(path)
    if folder and (set_folder := SetFolder(storage.absolute(folder))).recipe_path.is_file():
        return lambda: set_folder.recipe
    raise InputError("no recipe given: choose one, or write one with New Recipe")


def _read_event(path: Path, number: int) -> events.Event:
    """Return an event of a set; raise `InputError` where the set lacks it."""
    event_set = events.EventSet(path)
    if (event := next((event for event in event_set if event.number == number), None)) is None:
        numbers = event_set.numbers
        content = f"{count_text(len(numbers), 'event')}, {numbers[0]} to {numbers[-1]}" if len(numbers) else "no events"
        raise InputError(f"event {number}: not in {path}, which holds {content}")
    return event


def _store_phantom(planned: events.PlannedEvent, target: _Target, files: Path, progress: Progress) -> _Phantom:
    """Store the phantom of an event with its own voxels or, for a phantom of no kind, the truth; free of bpy."""
    entry, recipe, phantom, placement = planned.entry, planned.recipe, planned.phantom, planned.placement
    if entry.kind is None or phantom is None:
        stages_of(progress)("voxelizing")
        truth = events.EventMaker(recipe).truth(planned)
        return _Phantom([stored_volumes.store_volume(truth, files, placement, planned.all_settings)], None, placement)
    values: dict[str, Any] = {}
    phantom_fields: tuple[Any, ...] = fields(phantom)  # type: ignore[arg-type]
    for field in phantom_fields:
        if field.metadata:
            is_activity = field.metadata.get("unit", "").startswith("kBq")
            values[field.name] = _scaled(getattr(phantom, field.name), planned.activity_factor if is_activity else 1.0)
    if entry["gates"] > 1:
        values["frames"] = entry["gates"]
    voxels = target.voxels or min(_MAX_VOXELS, *recipe.grid.shape)
    settings = phantom_properties.plain_settings(entry.kind.name, **values, quantity=recipe.quantity, voxels=voxels)
    quantities = [recipe.quantity, *target.other_quantities]
    stored = phantoms.copy_settings(settings).voxelize(quantities, [placement] * len(quantities), files, progress)
    return _Phantom(stored, settings, placement)


def _scaled(value: Any, factor: float) -> Any:
    """Return a setting's value, or tuple of values, times a factor."""
    if factor == 1.0:
        return value
    return tuple(factor * number for number in value) if isinstance(value, tuple) else factor * value


def _place_phantom(scene: bpy.types.Scene, phantom: _Phantom, target: _Target) -> bpy.types.Object:
    """Give the scene's phantom an event's settings, voxels and pose, and return its object; add a new one if it is gone."""
    if (item := jobs.find_by_uid(bpy.data.objects, target.uid)) is None:
        item = volumes.add_stored(phantom.stored[0], "Event Phantom", scene.collection)
    if phantom.settings is None:
        volumes.replace_stored(item, phantom.stored[0])
        phantoms.remove_outline(item)
        item.mphdrr_volume.kind = "VOLUME"
        return item
    phantoms.store_settings(item, phantom.settings.identifier, phantom.settings.values())
    item.matrix_world = Matrix(phantom.placement)
    phantoms.replace_voxels(item, phantom.stored[: len(phantoms.with_children(item))])
    return item


def _phantom_to_try(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the scene's phantom to try an event on; None where a new one is to be made."""
    scene_phantoms = [item for item in volumes.volume_objects(context.scene) if phantoms.settings_of(item) is not None]
    panel_phantom = _item(context.scene, "phantom")
    if context.object in scene_phantoms:
        return context.object
    return panel_phantom or (scene_phantoms[0] if len(scene_phantoms) == 1 else None)


def _item(scene: bpy.types.Scene, name: str) -> bpy.types.Object | None:
    """Return an object that the panel's settings refer to; None if the user has deleted it."""
    item = getattr(scene.mphdrr_events, name)
    return item if item in volumes.volume_objects(scene) else None


def _make_target(item: bpy.types.Object | None) -> _Target:
    """Return the target that an object of the scene, or None, describes."""
    if item is None:
        return _Target()
    settings = phantoms.settings_of(item)
    other_quantities = tuple(volumes.quantity_of(child) for child in phantoms.with_children(item)[1:])
    return _Target(item.session_uid, other_quantities, 0 if settings is None else settings.voxels)


def _select(item: bpy.types.Object, hidden_item: bpy.types.Object | None) -> None:
    """Select a volume, and hide another one at the same place."""
    bpy.context.view_layer.update()  # makes it include new objects
    if hidden_item != item:
        objects.hide(hidden_item)
    if item.name in bpy.context.view_layer.objects:
        item.hide_set(False)
        volumes.make_active(bpy.context, item)


def _describe(planned: events.PlannedEvent) -> str:
    """Return an event's number, phantom, pose and factors in a line."""
    words = [f"event {planned.number}: {planned.name}", *([planned.split] if planned.split else [])]
    if any(planned.position):
        words.append("at {:.4g} {:.4g} {:.4g} mm".format(*planned.position))
    if any(planned.euler_degrees):
        words.append("turned by {:.4g} {:.4g} {:.4g}°".format(*planned.euler_degrees))
    words += ["mirrored"] if planned.mirror else []
    for name, factor in (("size", planned.size), ("activity", planned.activity_factor)):
        words += [f"{name} × {factor:.3g}"] if factor != 1.0 else []
    return ", ".join(words)
