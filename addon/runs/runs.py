"""The scene's projection runs: their list, and the changes of the scene since each was made.

With each run the scene's state is stored: the modules' numbers and the volumes' poses in float64, the volumes' content, and
the settings. The present scene is compared with it, so that undoing a change makes a run current again.
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
from ...core.recipes.settings import Setting
from ...core.runs.recipe import Recipe, fitting_recipe
from ...core.runs.run import PHOTONS, ProjectionRun
from ...core.runs.settings import SAMPLING, SETTINGS
from ..blender import decimals, ids, objects, reports, storage, timers, windows
from ..phantoms import phantoms
from ..pictures import images
from ..scanner import following, module_values, scanner, scanner_parts
from ..volumes import volumes
from .projection_properties import OPENING_ANGLE, settings_recipe

UNKNOWN = "made without this scene, or by an earlier version: its state is not known"
_OLD_COLUMNS = ("x1", "y1", "z1", "d", "l", "Ld", "Td", "R")  # columns in the states that earlier versions stored
_MAX_LINES = 3  # changes listed in a panel
_PRECISION = float(np.finfo(np.float32).eps)
_PAUSE = 0.3  # s from a change of the scene until the runs are compared with it
_DEFAULTS = {
    key: setting.default
    for key, setting in SETTINGS.items()
    if key.startswith(("model.", "scatter.", "detector.")) or key in ("noise.seed", "system.modules")
}
"""Defaults of the settings on which a run's numbers depend."""

_Changes = list[tuple[str, list[int] | None]]
"""Words, and numbers of the modules that the scene shows otherwise: None for all, none if only the panel has changed."""
_last_seen: dict[str, _Changes] = {}  # the changes that the panels show, by scene


def scene_state(
    system: Scanner, recipe: Recipe, item: bpy.types.Object | None, mu: bpy.types.Object | None
) -> dict[str, Any]:
    """Return the state of the scene from which a run is made, as JSON can hold it: modules, volume, attenuation, settings.

    A measured run has no volume (None): only its scanner can differ from the scene's.
    """
    return {
        "modules": _module_values(system),
        "volume": item and _volume_state(item),
        "mu": mu and _volume_state(mu),
        "settings": _effective_settings(recipe),
    }


def add_run(
    scene: bpy.types.Scene,
    run: ProjectionRun,
    path: Path,
    state: Mapping[str, Any],
    collection: bpy.types.Collection | None,
) -> None:
    """Add a run of the scanner `collection` to the end of the scene's list and mark it as shown.

    `path` is the run's file; `state` is that of the scene (`scene_state`), empty where it is not known. Of the runs that
    are not kept, all but the last are removed.
    """
    settings = scene.mphdrr_projections
    for index in reversed([i for i, item in enumerate(settings.runs) if not item.is_kept][:-1]):
        if not settings.runs[index].is_saved:
            remove_file(settings.runs[index])
        settings.runs.remove(index)
    time, (n_v, n_u) = run.settings.get("time"), run.views.shape
    seconds = f"{time:g} s" if isinstance(time, int | float) else None
    names = [run.settings.get(key) for key in ("volume", "counts")]
    # What differs from run to run stands first: the list is narrow.
    words = [_label("model.kind", run.settings.get("model")), seconds, f"{n_u} × {n_v}", *names]
    name = ", ".join(filter(None, words))
    names_in_list, number = {item.name for item in settings.runs}, 2
    unique = name
    while unique in names_in_list:
        unique, number = f"{name} {number}", number + 1
    item = settings.runs.add()
    item.name = item.usual_name = unique
    item.file, item.summary = storage.stored_path(storage.adopt(path.absolute())), run_summary(run)
    item.state, item.scanner = json.dumps(state) if state else "", collection
    mark_shown(scene, len(settings.runs) - 1)


def mark_shown(scene: bpy.types.Scene, index: int) -> None:
    """Store which run of the list has the images and planes; -1: none."""
    settings = scene.mphdrr_projections
    item = settings.runs[index] if index >= 0 else None
    with following.writing():
        settings.active_run = max(index, 0)
    settings.run_file, settings.run_summary = (item.file, item.summary) if item else ("", "")
    _compare()


def run_summary(run: ProjectionRun) -> str:
    """Return a run's number and size of images, its volume or counts, and its backend, in words."""
    n_v, n_u = run.views.shape
    backend = _label("compute.backend", run.settings.get("backend"))
    names = [run.settings.get("volume"), run.settings.get("counts"), backend]
    return ", ".join([f"{len(run.views)} views of {n_u} × {n_v}", *(text for text in names if text)])


def _label(key: str, word: Any) -> str | None:
    """Return the window's label for a word of a setting."""
    return SETTINGS[key].words.get(word, (word,))[0]


def shown_run(scene: bpy.types.Scene) -> bpy.types.PropertyGroup | None:
    """Return the run in the list whose images are shown; None where there is none."""
    settings = scene.mphdrr_projections
    return next((item for item in settings.runs if item.file == settings.run_file), None)


def subject_of(item: bpy.types.PropertyGroup) -> str:
    """Return the name of what a run is of, for results made from it: the user's, else its volume's, else the run's."""
    volume = json.loads(item.state).get("volume") if item.state and item.name == item.usual_name else None
    return str(volume["name"] if volume else item.name)


def run_settings(scene: bpy.types.Scene) -> Mapping[str, Any]:
    """Return all settings on which the shown run's numbers depend; empty where they are not known."""
    item = shown_run(scene)
    settings = json.loads(item.state).get("settings") if item is not None and item.state else None
    return {} if settings is None else {**_DEFAULTS, **settings}


def holds_counts(scene: bpy.types.Scene) -> bool | None:
    """Return whether the shown run holds SPECT counts; None where that is not known."""
    settings = run_settings(scene)
    return settings["model.kind"] == "emission" if settings else None


def parts_to_show(scene: bpy.types.Scene) -> list[tuple[str, str, bool]]:
    """Return identifier and label of each part of the shown run's photons, and whether it is shown; none without scatter."""
    if run_settings(scene).get("scatter.model", "none") == "none" or ids.MOSAIC not in bpy.data.images:
        return []
    shown_part = bpy.data.images[ids.MOSAIC].get(images.PHOTONS, "all")
    return [(part.upper(), label, part == shown_part) for part, label in PHOTONS.items()]


def required_run(scene: bpy.types.Scene, action: str) -> bpy.types.PropertyGroup:
    """Return the shown run; raise `InputError`, which names the `action`, where there is none."""
    if (item := shown_run(scene)) is None:
        raise InputError(f"nothing to {action}: render the projections first, or choose a run")
    return item


def changes(scene: bpy.types.Scene, item: bpy.types.PropertyGroup | None = None) -> list[str]:
    """Return in words the changes of the scene and its settings since a run, by default the shown one, was made."""
    return [text for text, _ in _changes(scene, item)]


def _changes(scene: bpy.types.Scene, item: bpy.types.PropertyGroup | None = None) -> _Changes:
    """Return the changes since a run, in words, with the modules concerned."""
    item = item or shown_run(scene)
    if item is None:
        return []
    if not item.state:
        return [(UNKNOWN, [])]
    try:
        return list(_differences(scene, json.loads(item.state), item.scanner))
    except InputError as error:
        return [(reports.in_window(error), None)]


def _last_changes(scene: bpy.types.Scene) -> _Changes:
    """Return the changes since the shown run; in a window, those found when the scene last rested."""
    return _changes(scene) if bpy.app.background else _last_seen.get(scene.name, [])


def stale_modules(scene: bpy.types.Scene) -> set[int] | None:
    """Return the numbers of the modules whose images in the shown run are out of date; None: all of them."""
    numbers = [numbers for _, numbers in _last_changes(scene)]
    return None if None in numbers else {number for group in numbers for number in group or ()}


def has_scene_changed(scene: bpy.types.Scene) -> bool:
    """Return whether the scene, not only the panel, has changed since the shown run."""
    return stale_modules(scene) != set()


def change_lines(scene: bpy.types.Scene) -> list[str]:
    """Return the changes since the shown run in a few lines, for panels."""
    texts = [text for text, _ in _last_changes(scene)]
    n_more = len(texts) - _MAX_LINES
    return texts if n_more <= 1 else [*texts[:_MAX_LINES], f"and {n_more} more changes"]


def volume_to_render(scene: bpy.types.Scene) -> str:
    """Return the name of the volume to project if the shown run is rendered again; "" where the panel has chosen one."""
    volume = None if scene.mphdrr_projections.volume is not None else projected_volume(scene)
    return "" if volume is None else str(volume.name)


def projected_volume(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the volume that the shown run is of; None where there is none."""
    item = shown_run(scene)
    return _find_volume(scene, json.loads(item.state)["volume"]) if item is not None and item.state else None


def measured_text(scene: bpy.types.Scene) -> str:
    """Return the shown run's note on its measured counts; "" for a simulated run."""
    item = shown_run(scene)
    return str(json.loads(item.state).get("measured", "")) if item is not None and item.state else ""


def file_size_text(items: Any) -> str:
    """Return in words the size of runs' files on the disk."""
    sizes = [storage.file_size(storage.absolute(item.file)) for item in items]
    missing = "file missing" if None in sizes else ""
    return ", ".join(filter(None, [readable_size(sum(filter(None, sizes))) if any(sizes) else "", missing]))


def remove_file(item: bpy.types.PropertyGroup) -> bool:
    """Remove a run's file if it is in this .blend's folder and no other run needs it; return whether the file is gone."""
    path = storage.absolute(item.file)
    users = [run.file for scene in bpy.data.scenes for run in scene.mphdrr_projections.runs].count(item.file)
    if not storage.is_in_folder(path) or users > 1:
        return not path.exists()
    with refusing(path, "cannot be removed"):
        path.unlink(missing_ok=True)
    return True


def after_load(*_: Any) -> None:
    """Make a list of runs in a file of an earlier version, which has one run and no list."""
    _last_seen.clear()
    for scene in bpy.data.scenes:
        settings = scene.mphdrr_projections
        if settings.run_file and not settings.runs:
            item = settings.runs.add()
            item.name = item.usual_name = (settings.run_summary.split(", ")[1:] or ["Run"])[0]
            item.file, item.summary, item.is_saved = settings.run_file, settings.run_summary, True
    after_update()


def after_update(*_: Any) -> None:
    """Schedule a comparison of the runs with the scene once it rests; costs almost nothing itself."""
    if not bpy.app.background:
        timers.schedule(_compare, _PAUSE)


def _compare() -> None:
    """Compare the shown runs with their scenes, and have the panels drawn again where the changes differ."""
    if bpy.app.background:
        return
    open_windows = bpy.context.window_manager.windows
    for window in open_windows:
        window.view_layer.update()  # a module that is being moved may not have been aimed yet
    changes_by_scene = {window.scene.name: _changes(window.scene) for window in open_windows}
    if any(_last_seen.get(name) != lines for name, lines in changes_by_scene.items()):
        _last_seen.update(changes_by_scene)
        windows.redraw_sidebars()
        windows.redraw("IMAGE_EDITOR")


def _volume_state(item: bpy.types.Object) -> dict[str, Any]:
    """Return the state of a volume for `scene_state`."""
    state = volumes.state_text(item) if item.data.is_sequence else ""
    pose = volumes.pose_of_object(item).tolist()
    return {"name": item.name, "content": volumes.content_key(item), "state": state, "pose": pose}


def panel_recipe(scene: bpy.types.Scene, collection: bpy.types.Collection | None = None) -> Recipe:
    """Return the recipe of the panel's settings, for a scanner, by default the active one."""
    collection = collection or scanner.active_scanner(scene)
    angle = math.pi / 2 if collection is None else collection.mphdrr_scanner.opening_angle
    extra = {OPENING_ANGLE: math.degrees(decimals.typed(angle))}
    return settings_recipe(lambda name: getattr(scene.mphdrr_projections, name), lambda name: False, extra, collection)


def _effective_settings(recipe: Recipe) -> dict[str, Any]:
    """Return the settings that have an effect, as JSON holds them."""
    entries = {key: value for key, value in recipe.given.items() if key in _DEFAULTS}
    fitting = fitting_recipe(_DEFAULTS | entries, entries).given
    return {key: list(value) if isinstance(value, tuple) else value for key, value in fitting.items()}


def _differences(
    scene: bpy.types.Scene, old: Mapping[str, Any], run_scanner: bpy.types.Collection | None
) -> Iterator[tuple[str, list[int] | None]]:
    """Yield the differences between the scene and an old state, in words, with the modules concerned."""
    collection = run_scanner if run_scanner in scanner.scanners(scene) else scanner.active_scanner(scene)
    yield from _module_changes(collection, old)
    if old["volume"] is None:
        return
    settings = _effective_settings(panel_recipe(scene, collection))
    panel = scene.mphdrr_projections
    volume = panel.volume or _find_volume(scene, old["volume"])
    mu = panel.mu if settings["model.kind"] == "emission" else None
    # `fitting_recipe` also completes the hole's settings of an earlier version.
    old_settings = _effective_settings(fitting_recipe(old["settings"]))
    for role, was, item in (("", old["volume"], volume), ("attenuation ", old["mu"], mu)):
        is_chosen = item != _find_volume(scene, was) and (item is not None or bool(role))  # another one, in the panel
        yield from ((text, [] if is_chosen else None) for text in _volume_changes(scene, role, was, item))
    yield from ((text, []) for text in _setting_changes(old_settings, settings))


def _module_changes(
    collection: bpy.types.Collection | None, old: Mapping[str, Any]
) -> Iterator[tuple[str, list[int] | None]]:
    """Yield the changes of a scanner's modules since an old state, in words, with the modules' numbers."""
    if collection is None:
        yield "the scanner is gone", None
        return
    kind, cameras_ = module_values.kind_of(collection), scanner.modules(collection)
    count, modes = len(cameras_), {str(o.mphdrr_module.number): o.mphdrr_module.length_mode for o in cameras_}
    current: dict[str, dict[str, Any]] = {}
    placement = module_values.read_placement(kind, cameras_, objects.world_matrices(cameras_))
    for _, system in module_values.read_in_groups(kind, cameras_, placement):
        if isinstance(system, InputError):
            yield str(system), None
        else:
            current |= _module_values(system)
    changed: dict[str, dict[int, tuple[Any, Any]]] = {}  # by column, then by module
    formula_names = {column.name for column in module_values.formula_columns(kind)}
    for number in old["modules"].keys() & current.keys():
        pairs = _changed_values(old["modules"][number], current[number])
        if modes[number] == module_values.FROM_ROI and len(pairs) > 1:
            pairs = {name: pair for name, pair in pairs.items() if name not in formula_names}
        for name, pair in pairs.items():
            changed.setdefault(name, {})[int(number)] = pair
    for verb, quantity in (("moved", "length"), ("turned", "angle")):
        axes = [name for name in changed if kind.columns[name].axis is not None and kind.columns[name].kind == quantity]
        if numbers := sorted({number for name in axes for number in changed[name]}):
            yield f"{_modules_text(numbers, count)} {verb}", numbers
    for column in kind.columns.scalars.values():
        if pairs_of := changed.get(column.name, {}):
            (old_value, new_value), *more_pairs = set(pairs_of.values())
            unit, factor = next(iter(column.units.items()))
            if not column.is_text:
                old_value, new_value = old_value / factor, new_value / factor
            text = "changed" if more_pairs else _change_text(old_value, new_value, unit)
            yield f"{_modules_text(sorted(pairs_of), count)}: {column.name} {text}", sorted(pairs_of)
    missing = [int(number) for number in old["modules"] if number not in modes]
    if missing:
        yield f"{_modules_text(missing, count)} {'are' if len(missing) > 1 else 'is'} gone", missing
    added = [] if "system.modules" in old["settings"] else [int(n) for n in modes if n not in old["modules"]]
    if added:
        yield f"{_modules_text(added, count)} added", added


def _module_values(system: Scanner) -> dict[str, dict[str, Any]]:
    """Return each module's values by column, as JSON holds them, by the module's number."""
    values = {name: column.tolist() for name, column in system.values().items()}
    rows = (dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True))
    return dict(zip(map(str, system.numbers.tolist()), rows, strict=True))


def _changed_values(old: Any, new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the changed values of a module as pairs (old, new), by column; an earlier version's `old` is a list."""
    values = old if isinstance(old, dict) else dict(zip(_OLD_COLUMNS, old, strict=True))
    return {name: (value, new[name]) for name, value in values.items() if name in new and not _equal(value, new[name])}


def _equal(old: Any, new: Any) -> bool:
    """Return whether two values are equal up to rounding on other machines: within 1e-12 for numbers."""
    if isinstance(old, str) or isinstance(new, str):
        return bool(old == new)
    return math.isclose(old, new, rel_tol=1e-12, abs_tol=1e-12)


def _modules_text(numbers: list[int], count: int) -> str:
    """Return a list of module numbers in words."""
    if len(numbers) == count > 1:
        return "all modules"
    return ids.module_name(numbers[0], count) if len(numbers) == 1 else scanner_parts.modules_text(numbers)


def _find_volume(scene: bpy.types.Scene, old: Mapping[str, Any] | None) -> bpy.types.Object | None:
    """Return the volume of a run, by its name or, if it was renamed, by its content; None for a measured run."""
    if old is None:
        return None
    scene_volumes = volumes.volume_objects(scene)
    matches = [item for item in scene_volumes if item.name == old["name"]]
    matches = matches or [item for item in scene_volumes if volumes.content_key(item) == old.get("content")]
    return next(iter(matches), None)


def _volume_changes(
    scene: bpy.types.Scene, role: str, old: Mapping[str, Any] | None, item: bpy.types.Object | None
) -> Iterator[str]:
    """Yield in words the changes of a volume since an old state; `role` is "" or "attenuation "."""
    if item is not None and item not in volumes.volume_objects(scene):
        item = None  # Blender keeps a volume that the user has deleted
    if old is None or item is None:
        if old is not None:
            yield f"{role}{old['name']}, now none" if role else f"volume {old['name']} is gone"
        elif item is not None:
            yield f"{role}none, now {item.name}"
        return
    current = _volume_state(item)
    has_same_voxels = current["content"] == old.get("content")  # a run made outside the scene may lack it
    if current["name"] != old["name"] and not has_same_voxels:
        yield f"{role or 'volume '}{old['name']}, now {current['name']}"
        return
    phantom = phantoms.owning_phantom(item)
    kind = role + ("volume" if phantom is None else "phantom")
    if not has_same_voxels or (phantom is not None and phantom.mphdrr_volume.outdated):
        yield f"{kind} {item.name} changed"
    if current["state"] != old["state"]:
        yield f"{kind} {item.name}: state {old['state'] or 'none'}, now {current['state'] or 'none'}"
    if motion := volumes.pose_change(np.array(old["pose"]), np.array(current["pose"])):
        yield f"{kind} {item.name} {motion}"


def _setting_changes(old: Mapping[str, Any], current: Mapping[str, Any]) -> Iterator[str]:
    """Yield in words the settings that differ from an old state."""
    is_other_model, is_other_hole = (old.get(key) != current.get(key) for key in ("model.kind", "model.hole"))
    for key, default in _DEFAULTS.items():
        if is_other_model and key.startswith(("model.", "noise.")) and key != "model.kind":
            continue
        if is_other_hole and key in SAMPLING:
            continue
        old_value, new_value = old.get(key, default), current.get(key, default)
        if not _is_same(old_value, new_value):
            setting = SETTINGS[key]
            words = setting.label.partition(" (")[0].split()
            name = " ".join(word.lower() if word[1:].islower() else word for word in words)
            yield f"{name} {_change_text(old_value, new_value, setting.unit, setting)}"


def _is_same(old: Any, new: Any) -> bool:
    """Return whether two values of a setting are equal in float32, as the scene keeps them."""
    numbers = all(isinstance(value, float | list) for value in (old, new)) and np.shape(old) == np.shape(new)
    return np.allclose(old, new, rtol=_PRECISION, atol=0) if numbers else bool(old == new)


def _change_text(old: Any, new: Any, unit: str, setting: Setting | None = None) -> str:
    """Return two values in words: "60 s, now 30 s"."""

    def words(value: Any, format_number: Callable[[Any], str]) -> str:
        """Return a value of the setting in words, with its unit; lists element by element."""
        if value is None:
            return "all" if setting is not None and setting.absent == "all" else "none"
        if isinstance(value, str):
            return setting.words[value][0] if setting is not None and value in setting.words else value
        if isinstance(value, bool):
            return "on" if value else "off"
        if isinstance(value, list):
            return ", ".join(words(x, format_number) for x in value)
        return f"{format_number(value)} {unit}".strip()

    short, exact = ([words(value, format_number) for value in (old, new)] for format_number in ("{:.6g}".format, repr))
    return ", now ".join(short if short[0] != short[1] else exact)
