"""A scanner designed by gradients in the window: it moves in the scene while the search goes on."""

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy

from ...core.design.optimising import Design, optimize
from ...core.design.recipe import read_design_recipe
from ...core.errors import Cancelled, warn
from ...core.geometry.system import PinholeSystem
from ...core.progress import Progress, stages_of
from ..blender import jobs
from . import following, module_edits, scanner

_RENDER = ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y")
_UNITS = ("system", "scale_length", "length_unit")
_PLACE = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
_MOST = 12  # free numbers, or faults, that the panel shows


def optimizing(scene: bpy.types.Scene, path: Path) -> jobs.Job:
    """The job that finds the scanner of a design recipe (.toml), by the same numbers as `optimize`.

    The active scanner becomes it, if it has modules of the same numbers; else a new one that is called like the recipe is
    added. Meanwhile it is the best until then. Raises InputError for a recipe that cannot be understood.
    """
    recipe, shown = read_design_recipe(path), _Shown(scene, path.stem)

    def work(progress: Progress) -> Design:
        try:
            return optimize(recipe, stages_of(progress)("designing"), callback=shown.note)
        except Cancelled as stop:
            if not shown.finish_now.is_set():
                raise
            return stop.design  # type: ignore[no-any-return]

    def finish(found: Design) -> str:
        collection = shown.show(found.system)
        scanner.check_geometry(collection)
        lines, many = found.summary(), len(found.parameters) > _MOST  # then the modules say what they are
        collection.mphdrr_scanner.design = json.dumps([*lines[many * len(found.parameters) :], *found.faults[:_MOST]])
        for fault in found.faults:
            warn(fault)
        stopped = f", stopped after {len(found.objective)} steps" * shown.finish_now.is_set()
        return f"Optimised '{collection.name}'{stopped}: {'; '.join(lines[len(found.parameters) :])}"

    return jobs.Job("Optimising", work, finish, shown.take_back, shown.refresh, shown.finish_now)


class _Shown:
    """The scanner in the scene that a search moves, to be taken back where the user cancels."""

    def __init__(self, scene: bpy.types.Scene, name: str) -> None:
        self.finish_now = threading.Event()
        active = scanner.active_scanner(scene)
        self._scene, self._name = scene.session_uid, name
        self._uid = 0 if active is None else active.session_uid
        self._latest: PinholeSystem | None = None  # found by the thread
        self._kept: dict[Any, dict[str, Any]] = {}
        self._is_new = False

    def note(self, system: PinholeSystem, objective: float) -> None:
        """Take the best until now, in the thread; raises Cancelled where that is enough."""
        self._latest = system
        if self.finish_now.is_set():
            raise Cancelled

    def refresh(self) -> None:
        """Show what the thread has found since."""
        latest, self._latest = self._latest, None
        if latest is not None:
            self.show(latest)

    def show(self, system: PinholeSystem) -> bpy.types.Collection:
        """Make the scanner the one found; the first call decides whether it is the one that was active."""
        scene = jobs.require_scene(self._scene, "the design is")
        collection = jobs.find_by_uid(bpy.data.collections, self._uid)
        if not self._kept:
            self._is_new = collection is None or not module_edits.can_become(collection, system)
            collection = None if self._is_new else collection
            self._kept = {key: _values(owner, names) for key, owner, names in _changed(scene, collection)}
        if collection is not None:
            module_edits.become(collection, system)
            return collection
        collection = scanner.build_scanner(scene, system, scanner.free_name(scene, self._name))
        self._uid = collection.session_uid
        return collection

    def take_back(self) -> None:
        """Leave the scene as it was."""
        scene = jobs.find_by_uid(bpy.data.scenes, self._scene)
        collection = jobs.find_by_uid(bpy.data.collections, self._uid)
        if not self._kept or scene is None or collection is None:
            return
        if self._is_new:
            module_edits.remove_scanner(scene, collection)
            collection = None
        with following.writing(), suppress(ReferenceError):  # an undo has taken what was there
            for key, owner, _ in _changed(scene, collection):
                for name, value in self._kept.get(key, {}).items():
                    setattr(owner, name, value)
        if collection is not None:
            following.refresh(collection, aim=False)


def _changed(
    scene: bpy.types.Scene, collection: bpy.types.Collection | None
) -> Iterator[tuple[Any, Any, Sequence[str]]]:
    """What a new scanner changes in the scene, or what modules that move change: keys, owners, names of properties."""
    if collection is None:
        yield "scene", scene, ("camera",)
        yield "render", scene.render, _RENDER
        yield "units", scene.unit_settings, _UNITS
        yield "chosen", scene.mphdrr_geometry, ("scanner", "active_index")
        return
    yield "scanner", collection.mphdrr_scanner, ()
    for camera in scanner.modules(collection):
        yield camera.session_uid, camera, _PLACE
        yield -camera.session_uid, camera.mphdrr_module, ()


def _values(owner: Any, names: Sequence[str]) -> dict[str, Any]:
    """Values of properties; without names of all that can be set."""
    known, found = owner.bl_rna.properties, {}
    for name in names or [property.identifier for property in known if not property.is_readonly]:
        value = getattr(owner, name)
        found[name] = value[:] if getattr(known[name], "is_array", False) else value
    return found
