"""Handlers: the scanner follows when cameras move, also after undo, redo and loading.

What follows is only ever changed in place (`design.refresh`). Copies and left-overs of the user's own Shift+D and X need
datablocks made and removed; that waits until Blender is idle and is an undo step of its own. One that the user has undone
is not done again: the panel offers it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import bpy

from . import copies, design, scanner

_INTERVAL = 0.2  # s between two looks whether a tool is still running
_overlooked = False  # something happened while rendering or playing
_undone: dict[str, str] = {}  # what an undo left untidy, in words, by scanner: the user wants it so


@bpy.app.handlers.persistent
def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Something was evaluated: modules that have moved are rebuilt; nothing else costs more than a look at the list."""
    _follow(scene, depsgraph, aim=True)


@bpy.app.handlers.persistent
def after_frame(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Another frame: what an animation moves is rebuilt, and looks where the animation has it look."""
    _follow(scene, depsgraph, aim=False)


def _follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, aim: bool) -> None:
    global _overlooked
    if depsgraph.mode != "VIEWPORT" or design.is_writing():
        return
    moved, structure = set(), _overlooked
    for update in depsgraph.updates:
        item = update.id.original
        if isinstance(item, bpy.types.Scene):
            structure = True  # objects were added, deleted, shown or hidden
        elif update.is_updated_transform and isinstance(item, bpy.types.Object) and item.mphdrr_module.is_module:
            moved.add(item)
    if not (moved or structure):
        return
    if _is_busy():
        _overlooked = True
        return
    _overlooked = False
    for collection in _own(scanner.scanners(scene)):
        found = scanner.modules(collection)
        changed = found if structure else [camera for camera in found if camera in moved]
        design.refresh(collection, found, changed, aim=aim)
        if structure:
            _look_for_copies(collection)


@bpy.app.handlers.persistent
def after_undo(*_: Any) -> None:
    """Undo and redo bring back some datablocks and leave others: make everything agree again."""
    _undone.clear()
    for collection in _own(bpy.data.collections):
        scanner.refresh_scanner(collection)
        with design.writing():
            collection.mphdrr_scanner.untidy = copies.untidy_text(collection)
        _undone[collection.name] = collection.mphdrr_scanner.untidy


@bpy.app.handlers.persistent
def after_load(*_: Any) -> None:
    """Modules of a file made by an older version share meshes and have no readouts. Nothing is tidied unasked."""
    for collection in _own(bpy.data.collections):
        copies.make_single_users(collection)
    after_undo()


def _own(collections: Iterable[bpy.types.Collection]) -> list[bpy.types.Collection]:
    """The scanners that are of this file, not linked from another."""
    return [c for c in collections if c.mphdrr_scanner.is_scanner and c.library is None]


def _is_busy() -> bool:
    playing = any(window.screen.is_animation_playing for window in bpy.context.window_manager.windows)
    return playing or bpy.app.is_job_running("RENDER")


def _look_for_copies(collection: bpy.types.Collection) -> None:
    text = copies.untidy_text(collection)
    properties = collection.mphdrr_scanner
    if properties.untidy != text:
        with design.writing():
            properties.untidy = text
    if _undone.get(collection.name) != text:
        _undone.pop(collection.name, None)
    if text and collection.name not in _undone and not bpy.app.background and not bpy.app.timers.is_registered(_tidy):
        bpy.app.timers.register(_tidy, first_interval=_INTERVAL)


def _tidy() -> float | None:
    """Tidy once no tool is running, e.g. the move that follows Shift+D."""
    windows = bpy.context.window_manager.windows
    if any(len(window.modal_operators) for window in windows) or _is_busy():
        return _INTERVAL
    if any(c.mphdrr_scanner.untidy for c in scanner.scanners(bpy.context.scene)):
        try:
            bpy.ops.mphdrr.tidy_modules("EXEC_DEFAULT", True)
        except RuntimeError as error:
            print(f"mphDRR: {error}", file=sys.stderr)
            _undone.update((c.name, c.mphdrr_scanner.untidy) for c in _own(bpy.data.collections))  # not over and over
    return None


def stop() -> None:
    """Forget what waits: the extension is disabled."""
    if bpy.app.timers.is_registered(_tidy):
        bpy.app.timers.unregister(_tidy)
