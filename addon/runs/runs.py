"""The scene's projection runs: their list, and what of the scene has changed since each was made.

With each run the scene's state is kept: the modules' numbers and the volumes' poses in float64, which voxels the volumes
held, and the settings. What the scene is now is compared with it, so that whatever goes back makes a run current again.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.errors import InputError, refusing
from ...core.geometry.scanner import Scanner
from ...core.memory import readable_size
from ...core.runs.recipe import Recipe, fitting_recipe
from ...core.runs.run import ProjectionRun
from ...core.runs.settings import SAMPLING, SETTINGS, Setting
from ..blender import decimals, ids, objects, reports, storage, timers, windows
from ..phantoms import phantoms
from ..scanner import following, module_values, scanner, scanner_parts
from ..volumes import volumes
from .projection_properties import OPENING_ANGLE, settings_recipe

UNKNOWN = "made without this scene, or by an earlier version: its state is not known"
_KEPT = ("x1", "y1", "z1", "d", "l", "Ld", "Td", "R")  # of a module in a state of earlier versions
_MOST = 3  # lines of differences
_PRECISION = float(np.finfo(np.float32).eps)
_REST = 0.3  # s after a change until the runs are compared with the scene
_DEFAULTS = {
    key: setting.default
    for key, setting in SETTINGS.items()
    if key.startswith(("model.", "detector.")) or key in ("noise.seed", "system.modules")
}
"""The settings that a run's numbers depend on."""

_Changes = list[tuple[str, list[int] | None]]  # words, and the modules' numbers, None where all images are concerned
_looked: dict[str, _Changes] = {}  # by scene: what its panels show


def state_of(
    system: Scanner, recipe: Recipe, item: bpy.types.Object | None, mu: bpy.types.Object | None
) -> dict[str, Any]:
    """What a run of `system` as `recipe` says is made from: the objects of its volume and attenuation.

    A measured run has no volume (None): only its scanner can differ from the scene's.
    """
    return {
        "modules": _values_of(system),
        "volume": item and _volume_state(item),
        "mu": mu and _volume_state(mu),
        "settings": _settings(recipe),
    }


def add(
    scene: bpy.types.Scene,
    run: ProjectionRun,
    path: Path,
    state: Mapping[str, Any],
    collection: bpy.types.Collection | None,
) -> None:
    """Put a run of the scanner `collection` at the end of the scene's list, as the one that is shown.

    It is kept in the file `path`; `state` is that of the scene (`state_of`), empty where it is not known. Runs that are not
    kept go, but for the last one.
    """
    settings = scene.mphdrr_projections
    for index in reversed([i for i, item in enumerate(settings.runs) if not item.is_kept][:-1]):
        if not settings.runs[index].is_saved:
            remove_file(settings.runs[index])
        settings.runs.remove(index)
    what = [run.settings.get(key) for key in ("volume", "counts")]
    name = ", ".join(filter(None, [*what, _label("model.kind", run.settings.get("model"))])) or "Run"
    known, number = {item.name for item in settings.runs}, 2
    unique = name
    while unique in known:
        unique, number = f"{name} {number}", number + 1
    item = settings.runs.add()
    item.name = item.usual_name = unique
    item.file, item.summary = storage.stored_path(path.absolute()), summary_of(run)
    item.state, item.scanner = json.dumps(state) if state else "", collection
    mark_shown(scene, len(settings.runs) - 1)


def mark_shown(scene: bpy.types.Scene, index: int) -> None:
    """Note which run of the list the images and planes are of; -1: none."""
    settings = scene.mphdrr_projections
    item = settings.runs[index] if index >= 0 else None
    with following.writing():
        settings.active_run = max(index, 0)
    settings.run_file, settings.run_summary = (item.file, item.summary) if item else ("", "")
    _look()


def summary_of(run: ProjectionRun) -> str:
    """How many images of which size a run has, of what, computed by what."""
    n_v, n_u = run.views.shape
    backend = _label("compute.backend", run.settings.get("backend"))
    what = [run.settings.get("volume"), run.settings.get("counts"), backend]
    return ", ".join([f"{len(run.views)} views of {n_u} × {n_v}", *(text for text in what if text)])


def _label(key: str, word: Any) -> str | None:
    """What the window calls a word of a setting."""
    return SETTINGS[key].words.get(word, (word,))[0]


def shown(scene: bpy.types.Scene) -> bpy.types.PropertyGroup | None:
    """The run in the list whose images are shown; None where there is none."""
    settings = scene.mphdrr_projections
    return next((item for item in settings.runs if item.file == settings.run_file), None)


def settings_of(scene: bpy.types.Scene) -> Mapping[str, Any]:
    """The settings that the `shown` run was made with, all that its numbers depend on; empty where they are not known."""
    item = shown(scene)
    settings = json.loads(item.state).get("settings") if item is not None and item.state else None
    return {} if settings is None else {**_DEFAULTS, **settings}


def holds_counts(scene: bpy.types.Scene) -> bool | None:
    """Whether the `shown` run is of SPECT counts; None where that is not known."""
    settings = settings_of(scene)
    return settings["model.kind"] == "emission" if settings else None


def required(scene: bpy.types.Scene, to_do: str) -> bpy.types.PropertyGroup:
    """The `shown` run; `InputError`, with what there was `to_do`, where there is none."""
    item = shown(scene)
    if item is None:
        raise InputError(f"nothing to {to_do}: render the projections first, or choose a run")
    return item


def changes(scene: bpy.types.Scene, item: bpy.types.PropertyGroup | None = None) -> list[str]:
    """What of the scene, and of its panel's settings, is not as it was for a run, by default the shown one, in words."""
    return [text for text, _ in _changes(scene, item)]


def _changes(scene: bpy.types.Scene, item: bpy.types.PropertyGroup | None = None) -> _Changes:
    item = item or shown(scene)
    if item is None:
        return []
    if not item.state:
        return [(UNKNOWN, [])]
    try:
        return list(_differences(scene, json.loads(item.state), item.scanner))
    except InputError as error:
        return [(reports.in_window(error), None)]


def _last_changes(scene: bpy.types.Scene) -> _Changes:
    """The changes of the shown run: in a window, as they were when it was last at rest."""
    return _changes(scene) if bpy.app.background else _looked.get(scene.name, [])


def stale_modules(scene: bpy.types.Scene) -> set[int] | None:
    """The numbers of the modules whose images in the shown run are not of the scene as it is now; None: all of them."""
    numbers = [numbers for _, numbers in _last_changes(scene)]
    return None if None in numbers else {number for each in numbers for number in each or ()}


def change_lines(scene: bpy.types.Scene) -> list[str]:
    """The `changes` of the shown run in a few lines, for panels: in a window, as they were when it was last at rest."""
    found = [text for text, _ in _last_changes(scene)]
    rest = len(found) - _MOST
    return found if rest <= 1 else [*found[:_MOST], f"and {rest} more changes"]


def volume_to_render(scene: bpy.types.Scene) -> str:
    """Name of the volume that is projected if the shown run is rendered again; "" where it is the panel's own choice."""
    found = None if scene.mphdrr_projections.volume is not None else projected(scene)
    return "" if found is None else str(found.name)


def projected(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The volume that the shown run is of; None where there is none."""
    item = shown(scene)
    return _found(scene, json.loads(item.state)["volume"]) if item is not None and item.state else None


def measured_text(scene: bpy.types.Scene) -> str:
    """What is known of the shown run's counts, where they were measured; else ""."""
    item = shown(scene)
    return str(json.loads(item.state).get("measured", "")) if item is not None and item.state else ""


def size_text(items: Any) -> str:
    """How much of the disk the files of runs need."""
    sizes = [storage.file_size(storage.absolute(item.file)) for item in items]
    missing = "file missing" if None in sizes else ""
    return ", ".join(filter(None, [readable_size(sum(filter(None, sizes))) if any(sizes) else "", missing]))


def remove_file(item: bpy.types.PropertyGroup) -> bool:
    """Remove a run's file if it is this .blend's own and no other run needs it; returns whether it is gone."""
    path = storage.absolute(item.file)
    needed = [run.file for scene in bpy.data.scenes for run in scene.mphdrr_projections.runs].count(item.file)
    if not storage.is_in_folder(path) or needed > 1:
        return not path.exists()
    with refusing(path, "cannot be removed"):
        path.unlink(missing_ok=True)
    return True


def after_load(*_: Any) -> None:
    """A file was opened; one of an earlier version has one run, and no list."""
    _looked.clear()
    for scene in bpy.data.scenes:
        settings = scene.mphdrr_projections
        if settings.run_file and not settings.runs:
            item = settings.runs.add()
            item.name = item.usual_name = (settings.run_summary.split(", ")[1:] or ["Run"])[0]
            item.file, item.summary, item.is_saved = settings.run_file, settings.run_summary, True
    after_update()


def after_update(*_: Any) -> None:
    """Something has changed: compare the runs with the scene once it rests. Costs next to nothing itself."""
    if not bpy.app.background:
        timers.schedule(_look, _REST)


def _look() -> None:
    """Compare the shown runs with their scenes, and have the panels drawn where that has changed."""
    if bpy.app.background:
        return
    shown_in = bpy.context.window_manager.windows
    for window in shown_in:
        window.view_layer.update()  # a module that is being moved may not have been aimed yet
    found = {window.scene.name: _changes(window.scene) for window in shown_in}
    if any(_looked.get(name) != lines for name, lines in found.items()):
        _looked.update(found)
        windows.redraw_sidebars()
        windows.redraw("IMAGE_EDITOR")


def _volume_state(item: bpy.types.Object) -> dict[str, Any]:
    state = volumes.state_text(item) if item.data.is_sequence else ""
    pose = volumes.pose_of_object(item).tolist()
    return {"name": item.name, "content": volumes.content_key(item), "state": state, "pose": pose}


def panel_recipe(scene: bpy.types.Scene, collection: bpy.types.Collection | None = None) -> Recipe:
    """What the panel asks for now, of a scanner, by default the active one."""
    collection = collection or scanner.active_scanner(scene)
    angle = math.pi / 2 if collection is None else collection.mphdrr_scanner.opening_angle
    more = {OPENING_ANGLE: math.degrees(decimals.typed(angle))}
    return settings_recipe(lambda name: getattr(scene.mphdrr_projections, name), lambda name: False, more, collection)


def _settings(recipe: Recipe) -> dict[str, Any]:
    """The settings that have an effect, as JSON holds them."""
    given = {key: value for key, value in recipe.given.items() if key in _DEFAULTS}
    found = fitting_recipe(_DEFAULTS | given, given).given
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found.items()}


def _differences(
    scene: bpy.types.Scene, old: Mapping[str, Any], own: bpy.types.Collection | None
) -> Iterator[tuple[str, list[int] | None]]:
    collection = own if own in scanner.scanners(scene) else scanner.active_scanner(scene)
    yield from _of_modules(collection, old)
    if old["volume"] is None:
        return
    settings = _settings(panel_recipe(scene, collection))
    panel = scene.mphdrr_projections
    chosen = panel.volume or _found(scene, old["volume"])
    mu = panel.mu if settings["model.kind"] == "emission" else None
    of_all = (
        _of_volume(scene, "", old["volume"], chosen),
        _of_volume(scene, "attenuation ", old["mu"], mu),
        _of_settings(_settings(fitting_recipe(old["settings"])), settings),  # with an earlier version's hole
    )
    yield from ((text, None) for texts in of_all for text in texts)


def _of_modules(
    collection: bpy.types.Collection | None, old: Mapping[str, Any]
) -> Iterator[tuple[str, list[int] | None]]:
    if collection is None:
        yield "the scanner is gone", None
        return
    kind, found = module_values.kind_of(collection), scanner.modules(collection)
    count, modes = len(found), {str(o.mphdrr_module.number): o.mphdrr_module.length_mode for o in found}
    now: dict[str, dict[str, Any]] = {}
    places = module_values.read_placement(kind, found, objects.world_matrices(found))
    for _, system in module_values.read_in_groups(kind, found, places):
        if isinstance(system, InputError):
            yield str(system), None
        else:
            now |= _values_of(system)
    changed: dict[str, dict[int, tuple[Any, Any]]] = {}  # by column, then by module
    follow = {column.name for column in module_values.formula_columns(kind)}
    for number in old["modules"].keys() & now.keys():
        pairs = _changed(old["modules"][number], now[number])
        if modes[number] == module_values.FROM_ROI and len(pairs) > 1:
            pairs = {name: pair for name, pair in pairs.items() if name not in follow}
        for name, pair in pairs.items():
            changed.setdefault(name, {})[int(number)] = pair
    for verb, what in (("moved", "length"), ("turned", "angle")):
        axes = [name for name in changed if kind.columns[name].axis is not None and kind.columns[name].kind == what]
        numbers = sorted({number for name in axes for number in changed[name]})
        if numbers:
            yield f"{_modules(numbers, count)} {verb}", numbers
    for column in kind.columns.scalars.values():
        pairs_of = changed.get(column.name, {})
        if pairs_of:
            (old_value, new_value), *others = set(pairs_of.values())
            unit, factor = next(iter(column.units.items()))
            if not column.is_text:
                old_value, new_value = old_value / factor, new_value / factor
            text = "changed" if others else _now(old_value, new_value, unit)
            yield f"{_modules(sorted(pairs_of), count)}: {column.name} {text}", sorted(pairs_of)
    gone = [int(number) for number in old["modules"] if number not in modes]
    if gone:
        yield f"{_modules(gone, count)} {'are' if len(gone) > 1 else 'is'} gone", gone
    new = [] if "system.modules" in old["settings"] else [int(n) for n in modes if n not in old["modules"]]
    if new:
        yield f"{_modules(new, count)} added", new


def _values_of(system: Scanner) -> dict[str, dict[str, Any]]:
    """Number of each module -> its values by column, as JSON holds them."""
    values = {name: column.tolist() for name, column in system.values().items()}
    rows = (dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True))
    return dict(zip(map(str, system.numbers.tolist()), rows, strict=True))


def _changed(old: Any, now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The values of a module that are not as they were, by column; earlier versions kept a list of `_KEPT`."""
    known = old if isinstance(old, dict) else dict(zip(_KEPT, old, strict=True))
    return {name: (known[name], now[name]) for name in known if name in now and not _equal(known[name], now[name])}


def _equal(old: Any, new: Any) -> bool:
    """Whether two values are one: numbers in float64, up to the rounding of other machines and of several at once."""
    if isinstance(old, str) or isinstance(new, str):
        return bool(old == new)
    return math.isclose(old, new, rel_tol=1e-12, abs_tol=1e-12)


def _modules(numbers: list[int], count: int) -> str:
    if len(numbers) == count > 1:
        return "all modules"
    return ids.module_name(numbers[0], count) if len(numbers) == 1 else scanner_parts.modules_text(numbers)


def _found(scene: bpy.types.Scene, old: Mapping[str, Any] | None) -> bpy.types.Object | None:
    """The volume of a run: by its name, or, if it was given another, by its voxels; None of a measured run."""
    if old is None:
        return None
    known = volumes.volume_objects(scene)
    by_name = [item for item in known if item.name == old["name"]]
    return next(iter(by_name or [item for item in known if volumes.content_key(item) == old["content"]]), None)


def _of_volume(
    scene: bpy.types.Scene, what: str, old: Mapping[str, Any] | None, item: bpy.types.Object | None
) -> Iterator[str]:
    if item is not None and item not in volumes.volume_objects(scene):
        item = None  # Blender keeps one that the user has deleted
    if old is None or item is None:
        if old is not None and what:
            yield f"{what}{old['name']}, now none"
        elif old is not None:
            yield f"volume {old['name']} is gone"
        elif item is not None:
            yield f"{what}none, now {item.name}"
        return
    now = _volume_state(item)
    same_voxels = now["content"] == old.get("content")  # which a run from outside may lack
    if now["name"] != old["name"] and not same_voxels:
        yield f"{what or 'volume '}{old['name']}, now {now['name']}"
        return
    phantom = phantoms.owning_phantom(item)
    kind = what + ("volume" if phantom is None else "phantom")
    if not same_voxels or (phantom is not None and phantom.mphdrr_volume.outdated):
        yield f"{kind} {item.name} changed"
    if now["state"] != old["state"]:
        yield f"{kind} {item.name}: state {old['state'] or 'none'}, now {now['state'] or 'none'}"
    if what := volumes.pose_change(np.array(old["pose"]), np.array(now["pose"])):
        yield f"{kind} {item.name} {what}"


def _of_settings(old: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    other_model, other_hole = (old.get(key) != now.get(key) for key in ("model.kind", "model.hole"))
    for key, default in _DEFAULTS.items():
        if other_model and key.startswith(("model.", "noise.")) and key != "model.kind":
            continue
        if other_hole and key in SAMPLING:
            continue
        one, two = old.get(key, default), now.get(key, default)
        if not _same(one, two):
            setting = SETTINGS[key]
            words = setting.label.partition(" (")[0].split()
            name = " ".join(word.lower() if word[1:].islower() else word for word in words)
            yield f"{name} {_now(one, two, setting.unit, setting)}"


def _same(old: Any, new: Any) -> bool:
    """Whether two values of a setting are one in float32, as the scene keeps them."""
    numbers = all(isinstance(value, float | list) for value in (old, new)) and np.shape(old) == np.shape(new)
    return np.allclose(old, new, rtol=_PRECISION, atol=0) if numbers else bool(old == new)


def _now(old: Any, new: Any, unit: str, setting: Setting | None = None) -> str:
    """Two values in words: "60 s, now 30 s"."""

    def words(value: Any, written: Callable[[Any], str]) -> str:
        if value is None:
            return "all" if setting is not None and setting.absent == "all" else "none"
        if isinstance(value, str):
            return setting.words[value][0] if setting is not None and value in setting.words else value
        if isinstance(value, bool):
            return "on" if value else "off"
        if isinstance(value, list):
            return ", ".join(words(x, written) for x in value)
        return f"{written(value)} {unit}".strip()

    short, exact = ([words(value, written) for value in (old, new)] for written in ("{:.6g}".format, repr))
    return ", now ".join(short if short[0] != short[1] else exact)
