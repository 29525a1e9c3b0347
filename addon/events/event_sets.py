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
from ...core.events.folders import SetFolder
from ...core.events.templates import template_text
from ...core.example import EXAMPLE
from ...core.files import write_bytes
from ...core.progress import Progress, stages_of
from ..blender import jobs, storage
from ..figures import studio
from ..phantoms import phantom_properties, phantoms
from ..pictures import images
from ..runs import rendering, runs
from ..scanner import scanner
from ..volumes import stored_volumes, volumes

_VOXELS = 128
"""Along each side of a phantom, at most, unless the phantom in the scene says another number."""


@dataclass(frozen=True)
class _Target:
    """The phantom in the scene that becomes that of an event, for a thread that leaves bpy alone."""

    uid: int = 0  # 0: there is none yet
    others: tuple[str, ...] = ()  # quantities of its other volumes
    voxels: int = 0  # along each side; 0: as the recipe says


@dataclass(frozen=True)
class _Phantom:
    """An event's phantom, its voxels stored."""

    stored: list[stored_volumes.StoredVolume]
    settings: phantom_properties.KindSettings | None  # None: of no kind, but a file's
    placement: NDArray[np.float64]  # world from object


def write_recipe(scene: bpy.types.Scene, filepath: str, like: str) -> str:
    """Write a recipe like one of `TEMPLATES`, of the scene's workbook or else the example's, and choose it in the panel."""
    if not filepath:
        raise InputError("no file given: set filepath to a name ending in .toml")
    path = storage.absolute(filepath)
    collection = scanner.active_scanner(scene)
    known = collection.mphdrr_scanner.workbook if collection is not None else ""
    workbook = storage.absolute(known) if known else EXAMPLE
    is_near = workbook.is_relative_to(path.parent)
    text = template_text(like, workbook.relative_to(path.parent).as_posix() if is_near else workbook)
    write_bytes(path, text.encode())
    scene.mphdrr_events.recipe = storage.stored_path(path)
    return f"Wrote {path}, of {workbook.name}: edit it in any editor of text"


def trying(context: bpy.types.Context, filepath: str, number: int, folder: str = "") -> jobs.Job:
    """The job that makes the phantom in the scene that of event `number` of a recipe, and counts the panel's number up.

    Without a recipe's file it is the recipe of the set in `folder`. The phantom is the active one, else that which was tried
    last, else the scene's only one, else a new one. Its object is placed with the event's mirroring and size; a factor of
    activity is in its settings. Raises InputError.
    """
    read, scene, files = _reading(filepath, folder), context.scene, storage.folder()
    target, uid = _target_of(_phantom_to_try(context)), scene.session_uid

    def work(progress: Progress) -> tuple[_Phantom, str]:
        planned = events.plan(read(), number)
        return _phantom_of(planned, target, files, progress), _text(planned)

    def finish(made: tuple[_Phantom, str]) -> str:
        phantom, text = made
        scene = jobs.scene_again(uid, "the event is")
        settings = scene.mphdrr_events
        item = _put(scene, phantom, target)
        settings.phantom, settings.tried, settings.number = item, text, number + 1
        _show(item, settings.truth)
        return f"{item.name!r} is now the phantom of {text}"

    return jobs.Job("Trying an event", work, finish)


def making(filepath: str, folder: str, count: int) -> jobs.Job:
    """The job that makes the first `count` events of a recipe in a set's folder, those that are not there yet.

    Without a recipe's file it is the folder's own. What is made stays, also where the user cancels. Raises InputError.
    """
    if not folder:
        raise InputError("no folder given: choose a new one for the event set, or that of a set to go on with")
    read, path = _reading(filepath, folder), storage.absolute(folder)
    made: list[events.Made] = []

    def work(progress: Progress) -> float:
        start = time.perf_counter()
        within = stages_of(progress)("making events") or progress

        def step(done: int, steps: int) -> None:
            """Between the steps of an event: says how many events are done, and stops where the user wants that."""
            within(len(made), made[-1].total if made else 0)

        for event in events.making(read(), path, count, progress=step):
            made.append(event)
            step(0, 0)
        return time.perf_counter() - start

    def finish(seconds: float) -> str:
        there = len(SetFolder(path).store.locations())
        if not made:
            return f"All events asked for are there already: {there} in {path}"
        size = memory.readable_size(sum(event.size for event in made))
        return f"Made {_events(len(made))}, {size} in {seconds:.1f} s: {there} in {path}"

    def left() -> str:
        return f"{_events(len(made))} made now and kept; Make Event Set goes on from there"

    return jobs.Job("Making an event set", work, finish, left=left)


@dataclass(frozen=True)
class _Opened:
    """An event, ready to be put into the scene."""

    name: str
    text: str
    truth: stored_volumes.StoredVolume
    phantom: _Phantom | None  # of one that a volume's file describes: the truth is all there is
    run: ProjectionRun | None
    pictures: images.Pictures | None


def opening(context: bpy.types.Context, folder: str, number: int, model: str = "") -> jobs.Job:
    """The job that puts an event of the set in a folder into the scene, in place of the one that was opened before.

    Its truth is a volume, whose object has the event's pose; its phantom is hidden, and the projections of a model, by
    default the first, are a run, of the set's scanner where the scene has none. Raises InputError.
    """
    if not folder:
        raise InputError("no folder given: choose that of an event set")
    scene, path, files = context.scene, storage.absolute(folder), storage.folder()
    target, truth_uid = _target_of(_own(scene, "phantom")), getattr(_own(scene, "truth"), "session_uid", 0)
    run_file, display, uid = rendering.run_path(scene), scene.mphdrr_display.display(), scene.session_uid

    def work(progress: Progress) -> _Opened:
        stages = stages_of(progress)
        stages("reading the event")
        event = _event(path, number)
        name, planned = f"Event {number} {event.name}", event.planned
        stages("writing the voxels")
        truth = stored_volumes.store_volume(event.truth, files, event.placement, {"event": number, "set": str(path)})
        phantom = None if planned.entry.kind is None else _phantom_of(planned, target, files, progress)
        models = planned.recipe.models
        if not models:
            return _Opened(name, _text(planned), truth, phantom, None, None)
        run = event.run(model or next(iter(models)))
        run = replace(run, settings={**run.settings, "volume": name})
        return _Opened(name, _text(planned), truth, phantom, run, rendering.kept(run, run_file, display, stages))

    def finish(opened: _Opened) -> jobs.Finishing:
        run, mosaic = opened.run, None
        if run is not None and opened.pictures is not None:
            mosaic = yield from images.storing(run, opened.pictures)
        scene = jobs.scene_again(uid, "the event is")
        settings = scene.mphdrr_events
        collection = scanner.active_scanner(scene)
        if run is not None and collection is None:
            collection = scanner.build_scanner(scene, run.system)
            studio.light(scene)
            yield None
        if opened.phantom is not None:
            settings.phantom = _put(scene, opened.phantom, target)
            yield None
        item = jobs.found_again(bpy.data.objects, truth_uid)
        if item is None:
            item = volumes.add_stored(opened.truth, opened.name, scene.collection)
        else:
            volumes.replace_stored(item, opened.truth)
            item.name = opened.name
        settings.truth, settings.tried = item, opened.text
        _show(item, settings.phantom)
        yield None
        if run is not None:
            rendering.place(scene, run, collection)
            runs.add(scene, run, run_file, rendering.taken_over(scene, run, item), collection)
            images.show_below(mosaic, bpy.context)
        return f"Opened {opened.text}" + ("" if run is not None else "; it has no projections of a model")

    return jobs.Job("Opening an event", work, finish, lambda: run_file.unlink(missing_ok=True))


def _reading(filepath: str, folder: str) -> Callable[[], events.EventRecipe]:
    """What reads a recipe's file, or else the recipe of a set, in a thread; `InputError` where neither is given."""
    if filepath:
        path = storage.absolute(filepath)
        return lambda: events.read_recipe(path)
    if folder and SetFolder(storage.absolute(folder)).recipe_path.is_file():
        found = SetFolder(storage.absolute(folder))
        return lambda: found.recipe
    raise InputError("no recipe given: choose one, or write one with New Recipe")


def _event(path: Path, number: int) -> events.Event:
    found = events.EventSet(path)
    event = next((event for event in found if event.number == number), None)
    if event is None:
        there = f"{_events(len(found))}, {found.numbers[0]} to {found.numbers[-1]}" if len(found) else "no events"
        raise InputError(f"event {number}: not in {path}, which holds {there}")
    return event


def _phantom_of(planned: events.PlannedEvent, target: _Target, files: Path, progress: Progress) -> _Phantom:
    """The phantom of an event with its own voxels, or, of one that is of no kind, the truth; leaves bpy alone."""
    entry, recipe, phantom, placement = planned.entry, planned.recipe, planned.phantom, planned.placement
    if entry.kind is None or phantom is None:
        stages_of(progress)("voxelizing")
        truth = events.EventMaker(recipe).truth(planned)
        return _Phantom([stored_volumes.store_volume(truth, files, placement, planned.all_settings)], None, placement)
    values: dict[str, Any] = {}
    known: tuple[Any, ...] = fields(phantom)  # type: ignore[arg-type]
    for field in known:
        if field.metadata:
            is_activity = field.metadata.get("unit", "").startswith("kBq")
            values[field.name] = _times(getattr(phantom, field.name), planned.activity_factor if is_activity else 1.0)
    if entry["gates"] > 1:
        values["frames"] = entry["gates"]
    voxels = target.voxels or min(_VOXELS, *recipe.grid.shape)
    settings = phantom_properties.plain_settings(entry.kind.name, **values, quantity=recipe.quantity, voxels=voxels)
    quantities = [recipe.quantity, *target.others]
    made = phantoms.recipe_of(settings).voxelize(quantities, [placement] * len(quantities), files, progress)
    return _Phantom(made, settings, placement)


def _times(value: Any, factor: float) -> Any:
    if factor == 1.0:
        return value
    return tuple(factor * number for number in value) if isinstance(value, tuple) else factor * value


def _put(scene: bpy.types.Scene, phantom: _Phantom, target: _Target) -> bpy.types.Object:
    """Give the phantom in the scene an event's settings, voxels and place; a new one where there is none any more."""
    item = jobs.found_again(bpy.data.objects, target.uid)
    if item is None:
        item = volumes.add_stored(phantom.stored[0], "Event Phantom", scene.collection)
    if phantom.settings is None:
        volumes.replace_stored(item, phantom.stored[0])
        phantoms.remove_outline(item)
        item.mphdrr_volume.kind = "VOLUME"
        return item
    phantoms.take_settings(item, phantom.settings.identifier, phantom.settings.values())
    item.matrix_world = Matrix(phantom.placement)
    phantoms.replace(item, phantom.stored[: len(phantoms.with_children(item))])
    return item


def _phantom_to_try(context: bpy.types.Context) -> bpy.types.Object | None:
    """The phantom of the scene that is meant; None where a new one is to be made."""
    known = [item for item in volumes.volume_objects(context.scene) if phantoms.settings_of(item) is not None]
    own = _own(context.scene, "phantom")
    if context.object in known:
        return context.object
    return own or (known[0] if len(known) == 1 else None)


def _own(scene: bpy.types.Scene, name: str) -> bpy.types.Object | None:
    """The object that the panel's settings point to, unless the user has deleted it: Blender keeps it there."""
    item = getattr(scene.mphdrr_events, name)
    return item if item in volumes.volume_objects(scene) else None


def _target_of(item: bpy.types.Object | None) -> _Target:
    if item is None:
        return _Target()
    settings = phantoms.settings_of(item)
    others = tuple(volumes.quantity_of(child) for child in phantoms.with_children(item)[1:])
    return _Target(item.session_uid, others, 0 if settings is None else settings.voxels)


def _show(item: bpy.types.Object, other: bpy.types.Object | None) -> None:
    """Select a volume, and hide the other one, which is at the same place."""
    bpy.context.view_layer.update()  # or it does not know new objects
    known = bpy.context.view_layer.objects
    if other is not None and other != item and other.name in known:
        other.hide_set(True)
    if item.name in known:
        item.hide_set(False)
        volumes.make_active(bpy.context, item)


def _text(planned: events.PlannedEvent) -> str:
    """What an event is, in a line."""
    parts = [f"event {planned.number}: {planned.name}", *([planned.split] if planned.split else [])]
    if any(planned.position):
        parts.append("at {:.4g} {:.4g} {:.4g} mm".format(*planned.position))
    if any(planned.euler_degrees):
        parts.append("turned by {:.4g} {:.4g} {:.4g}°".format(*planned.euler_degrees))
    parts += ["mirrored"] if planned.mirror else []
    for name, factor in (("size", planned.size), ("activity", planned.activity_factor)):
        parts += [f"{name} × {factor:.3g}"] if factor != 1.0 else []
    return ", ".join(parts)


def _events(count: int) -> str:
    return f"{count} event{'s' * (count != 1)}"
