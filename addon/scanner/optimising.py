"""A scanner designed by gradients in the window: it moves in the scene while the search goes on."""

import itertools
import json
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy

from ...core.design.optimising import Design, optimize
from ...core.design.recipe import read_design_recipe
from ...core.errors import Cancelled, warn
from ...core.geometry.system import PinholeSystem
from ...core.progress import Progress, stages_of, tell
from ..blender import jobs
from . import following, module_edits, scanner

_SCENE = {
    "render": ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y"),
    "unit_settings": ("system", "scale_length", "length_unit"),
    "mphdrr_geometry": ("scanner", "active_index"),
}
"""What building a scanner sets."""
_PLACE = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")


def optimizing(scene: bpy.types.Scene, path: Path) -> jobs.Job:
    """The job that finds the scanner of a design recipe (.toml), by the same numbers as `optimize`.

    The active scanner becomes it, if it has modules of the same numbers; else a new one that is called like the recipe is
    added. Meanwhile it is the best until then. Raises InputError for a recipe that cannot be understood.
    """
    recipe, shown = read_design_recipe(path), _Shown(scene, path.stem)

    def work(progress: Progress) -> Design:
        designing = stages_of(progress)("designing")

        def step(done: int, total: int) -> None:
            tell(designing, done, total)  # raises Cancelled where the user does not want it
            if shown.enough.is_set():
                raise Cancelled

        try:
            return optimize(recipe, step, callback=shown.note)
        except Cancelled as stop:
            if not shown.enough.is_set():
                raise
            return stop.design  # type: ignore[no-any-return]

    def finish(found: Design) -> str:
        collection = shown.show(found.system)
        scanner.check_geometry(collection)
        lines, stopped = found.summary(), f", stopped after {len(found.objective)} steps" * shown.enough.is_set()
        collection.mphdrr_scanner.design = json.dumps([lines, found.faults])
        for fault in found.faults:
            warn(fault)
        return f"Optimised '{collection.name}'{stopped}: {'; '.join(lines[len(found.parameters) :])}"

    return jobs.Job("Optimising", work, finish, shown.take_back, shown.look, shown.enough)


class _Shown:
    """The scanner in the scene that a search moves, to be taken back where the user cancels."""

    def __init__(self, scene: bpy.types.Scene, name: str) -> None:
        self.enough = threading.Event()
        active = scanner.active_scanner(scene)
        self._scene, self._name = scene.session_uid, name
        self._uid = 0 if active is None else active.session_uid
        self._latest: PinholeSystem | None = None  # found by the thread
        self._back: Callable[[], None] | None = None

    def note(self, system: PinholeSystem, objective: float) -> None:
        """Take the best until now, in the thread."""
        self._latest = system

    def look(self) -> None:
        """Show what the thread has found since."""
        latest, self._latest = self._latest, None
        if latest is not None:
            self.show(latest)

    def show(self, system: PinholeSystem) -> bpy.types.Collection:
        """Make the scanner the one found; the first call decides whether it is the one that was active."""
        scene = jobs.scene_again(self._scene, "the design is")
        collection = jobs.found_again(bpy.data.collections, self._uid)
        if self._back is None and (collection is None or not module_edits.can_become(collection, system)):
            collection, self._back = None, self._removing(scene)
        if collection is None:  # or the user has deleted it
            collection = scanner.build_scanner(scene, system, _free_name(scene, self._name))
            self._uid = collection.session_uid
            return collection
        self._back = self._back or _restoring(collection)
        module_edits.become(collection, system)
        return collection

    def take_back(self) -> None:
        """Leave the scene as it was."""
        if self._back is not None:
            self._back()

    def _removing(self, scene: bpy.types.Scene) -> Callable[[], None]:
        """What removes the new scanner, and sets the scene as it is now."""
        camera, kept = scene.camera, {owner: _values(getattr(scene, owner), names) for owner, names in _SCENE.items()}

        def remove() -> None:
            scene = jobs.found_again(bpy.data.scenes, self._scene)
            collection = jobs.found_again(bpy.data.collections, self._uid)
            if scene is None or collection is None:
                return
            module_edits.remove_scanner(scene, collection)
            with suppress(ReferenceError), following.writing():  # an undo in between
                scene.camera = camera
                for owner, values in kept.items():
                    _set(getattr(scene, owner), values)

        return remove


def _restoring(collection: bpy.types.Collection) -> Callable[[], None]:
    """What makes a scanner and its modules again what they are now."""
    uid, own = collection.session_uid, _values(collection.mphdrr_scanner)
    modules = {
        camera.session_uid: (_values(camera, _PLACE), _values(camera.mphdrr_module))
        for camera in scanner.modules(collection)
    }

    def restore() -> None:
        collection = jobs.found_again(bpy.data.collections, uid)
        if collection is None:
            return
        with following.writing():
            for camera in scanner.modules(collection):
                place, values = modules.get(camera.session_uid, ({}, {}))
                _set(camera, place)
                _set(camera.mphdrr_module, values)
            _set(collection.mphdrr_scanner, own)
        following.refresh(collection, aim=False)

    return restore


def _values(owner: Any, names: Iterable[str] = ()) -> dict[str, Any]:
    """Properties by their names; by default all that can be set."""
    known = owner.bl_rna.properties
    names = names or [property.identifier for property in known if not property.is_readonly]
    return {
        name: getattr(owner, name)[:] if getattr(known[name], "is_array", False) else getattr(owner, name)
        for name in names
    }


def _set(owner: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        setattr(owner, name, value)


def _free_name(scene: bpy.types.Scene, name: str) -> str:
    """A name that no scanner has yet: such as "design", or "design 2"."""
    names = itertools.chain([name], (f"{name} {number}" for number in itertools.count(2)))
    return next(each for each in names if scanner.find_scanner(scene, each) is None)
