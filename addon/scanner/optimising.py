"""Optimisation of a scanner by gradients in the window: the scanner moves in the scene while the search goes on."""

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
_POSE = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")
_MAX_LINES = 12  # largest number of parameters, or of faults, that the panel lists


def optimize_job(scene: bpy.types.Scene, path: Path) -> jobs.Job:
    """Return the job that finds the scanner of a design recipe (.toml), with the same numbers as `optimize`.

    The active scanner becomes the result, if it has modules of the same numbers; else a new one, named after the recipe, is
    added. Meanwhile it shows the best so far. Raises InputError for a recipe that cannot be understood.
    """
    recipe, live = read_design_recipe(path), _LiveDesign(scene, path.stem)

    def work(progress: Progress) -> Design:
        """Search for the best scanner; return the best design also where the user finishes the search early."""
        try:
            return optimize(recipe, stages_of(progress)("designing"), callback=live.store_best)
        except Cancelled as stop:
            if not live.finish_now.is_set():
                raise
            return stop.design  # type: ignore[no-any-return]

    def finish(design: Design) -> str:
        """Show the design in the scene, and return the line to report."""
        collection = live.show(design.system)
        scanner.check_geometry(collection)
        lines, n = design.summary(), len(design.parameters)
        omitted = n * (n > _MAX_LINES)  # the lines of too many parameters, which the modules show anyway
        collection.mphdrr_scanner.design = json.dumps([*lines[omitted:], *design.faults[:_MAX_LINES]])
        for fault in design.faults:
            warn(fault)
        stopped = f", stopped after {len(design.objective)} steps" * live.finish_now.is_set()
        return f"Optimised '{collection.name}'{stopped}: {'; '.join(lines[n:])}"

    return jobs.Job("Optimising", work, finish, live.restore, live.refresh, live.finish_now)


class _LiveDesign:
    """Scanner in the scene that shows the best design so far; the scene is restored where the user cancels."""

    def __init__(self, scene: bpy.types.Scene, name: str) -> None:
        self.finish_now = threading.Event()
        active = scanner.active_scanner(scene)
        self._scene, self._name = scene.session_uid, name
        self._collection_uid = 0 if active is None else active.session_uid
        self._unseen: PinholeSystem | None = None  # the best design that is not shown yet
        self._old_values: dict[Any, dict[str, Any]] = {}
        self._is_new = False

    def store_best(self, system: PinholeSystem, objective: float) -> None:
        """Store the best design so far, in the worker thread; raise `Cancelled` once the user wants to finish."""
        self._unseen = system
        if self.finish_now.is_set():
            raise Cancelled

    def refresh(self) -> None:
        """Show the best design since the last call."""
        system, self._unseen = self._unseen, None
        if system is not None:
            self.show(system)

    def show(self, system: PinholeSystem) -> bpy.types.Collection:
        """Make the scanner show a design; the first call decides whether it is the active scanner or a new one."""
        scene = jobs.require_scene(self._scene, "the design is")
        collection = jobs.find_by_uid(bpy.data.collections, self._collection_uid)
        if not self._old_values:
            self._is_new = collection is None or not module_edits.has_modules_of(collection, system)
            collection = None if self._is_new else collection
            self._old_values = {key: _read_values(owner, names) for key, owner, names in _to_restore(scene, collection)}
        if collection is not None:
            module_edits.set_modules(collection, system)
            return collection
        collection = scanner.build_scanner(scene, system, scanner.free_name(scene, self._name))
        self._collection_uid = collection.session_uid
        return collection

    def restore(self) -> None:
        """Restore the scene as it was before the search."""
        scene = jobs.find_by_uid(bpy.data.scenes, self._scene)
        collection = jobs.find_by_uid(bpy.data.collections, self._collection_uid)
        if not self._old_values or scene is None or collection is None:
            return
        if self._is_new:
            module_edits.remove_scanner(scene, collection)
            collection = None
        with following.writing(), suppress(ReferenceError):  # an undo may have removed the owners
            for key, owner, _ in _to_restore(scene, collection):
                for name, value in self._old_values.get(key, {}).items():
                    setattr(owner, name, value)
        if collection is not None:
            following.refresh(collection, aim=False)


def _to_restore(
    scene: bpy.types.Scene, collection: bpy.types.Collection | None
) -> Iterator[tuple[Any, Any, Sequence[str]]]:
    """Yield (key, owner, property names) of everything that moved modules of `collection` change, or else a new scanner."""
    if collection is None:
        yield "scene", scene, ("camera",)
        yield "render", scene.render, _RENDER
        yield "units", scene.unit_settings, _UNITS
        yield "chosen", scene.mphdrr_geometry, ("scanner", "active_index")
        return
    yield "scanner", collection.mphdrr_scanner, ()
    for camera in scanner.modules(collection):
        yield camera.session_uid, camera, _POSE
        yield -camera.session_uid, camera.mphdrr_module, ()


def _read_values(owner: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return the values of an owner's properties; without `names`, of all that can be set."""
    properties, values = owner.bl_rna.properties, {}
    for name in names or [property.identifier for property in properties if not property.is_readonly]:
        value = getattr(owner, name)
        values[name] = value[:] if getattr(properties[name], "is_array", False) else value
    return values
