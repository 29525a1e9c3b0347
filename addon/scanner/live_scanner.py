"""Handlers: scanners follow when cameras move, after undo and redo, and when a file is loaded.

Cameras that the user copied or deleted with Blender's own Shift+D and X need datablocks made and removed: that waits until
Blender is idle, and is an undo step of its own. Disorder that an undo brings back is left; the panel offers to tidy it.
"""

import sys
from collections.abc import Iterable
from typing import Any

import bpy

from ..blender import timers
from . import following, grabbing, module_edits, scanner

_INTERVAL = 0.2  # s between two checks whether a tool is still running
_missed_update = False  # the scene has changed while rendering or playing
_needs_undo_step = False  # modules have moved since the last undo step
_untidy_after_undo: dict[str, str] = {}  # disorder left by the last undo, in words, by scanner


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Rebuild modules that have moved, after Blender has evaluated the scene."""
    _follow(scene, depsgraph, aim=True)


def after_frame(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Rebuild modules that an animation has moved to a new frame; they keep the direction that it gives them."""
    _follow(scene, depsgraph, aim=False)


def _follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, aim: bool) -> None:
    """Make scanners follow an evaluation of the scene; `aim` lets them keep their modules aimed."""
    global _missed_update
    if depsgraph.mode != "VIEWPORT" or following.is_writing():
        return
    # Both are updated when objects were added, deleted, shown or hidden; selecting updates the scene alone.
    is_restructured = _missed_update or (depsgraph.id_type_updated("SCENE") and depsgraph.id_type_updated("COLLECTION"))
    updates = [u for u in depsgraph.updates if u.id.id_type == "OBJECT"]
    transformed = [u.id.original for u in updates if u.is_updated_transform]
    # Blender does not tell that an animation or a driver has changed a module's number, so every animated one is checked.
    animated = [u.id.original for u in updates if u.id.animation_data is not None]
    moved = {item for item in transformed if item.mphdrr_module.is_module and following.has_moved(item)}
    moved |= {item for item in animated if item.mphdrr_module.is_module}
    candidates = scene.objects if _missed_update else transformed
    displaced = [item for item in candidates if grabbing.is_module_part(item) and grabbing.is_displaced(item)]
    if not (moved or displaced or is_restructured):
        return
    was_missed, _missed_update = _missed_update, _is_busy()
    if _missed_update:
        return
    moved |= _follow_parts(displaced)
    for collection in _local_scanners(scanner.scanners(scene)):
        to_refresh = [camera for camera in moved if collection.all_objects.get(camera.name) == camera]
        if is_restructured:
            to_refresh = [o for o in scanner.modules(collection) if was_missed or o in moved or following.has_moved(o)]
        following.refresh(collection, to_refresh, aim)
        if is_restructured:
            _check_order(collection)


def _follow_parts(displaced: list[bpy.types.Object]) -> set[bpy.types.Object]:
    """Move modules with their displaced parts and return the modules' cameras."""
    global _needs_undo_step
    dragging = grabbing.is_dragging()
    # Blender stores an undo step when a drag ends; a script's motion was stored before the cameras followed.
    _needs_undo_step |= bool(displaced) and not dragging and not all(map(grabbing.is_dragged, displaced))
    moved = grabbing.move_modules_with(displaced, dragging)
    if displaced:
        _schedule_tidying()
    return moved


def after_undo(*_: Any) -> None:
    """Make parts, modules and readouts agree again: Undo and Redo restore only some datablocks."""
    global _needs_undo_step
    _untidy_after_undo.clear()
    _needs_undo_step = False
    for item in filter(grabbing.is_module_part, bpy.data.objects):
        if grabbing.is_dragged(item):
            grabbing.finish_drag(item)
        elif grabbing.is_displaced(item):  # the undo step has the camera before it followed: the part goes back
            grabbing.put_back(item)
    for collection in _local_scanners(bpy.data.collections):
        following.refresh(collection)
        with following.writing():
            collection.mphdrr_scanner.untidy = module_edits.untidy_text(collection)
        _untidy_after_undo[collection.name] = collection.mphdrr_scanner.untidy


def after_load(*_: Any) -> None:
    """Bring the scanners of a loaded file up to date; nothing is tidied unasked.

    In files of an older version, modules share meshes and have no readouts, and parts are locked.
    """
    for collection in _local_scanners(bpy.data.collections):
        module_edits.make_single_users(collection)
        if not collection.mphdrr_scanner.parts_free:
            for item in filter(grabbing.is_module_part, collection.all_objects):
                item.lock_location = item.lock_rotation = (False, False, False)
            collection.mphdrr_scanner.parts_free = True
    after_undo()


def _local_scanners(collections: Iterable[bpy.types.Collection]) -> list[bpy.types.Collection]:
    """Return the scanners that are not linked from another file."""
    return [c for c in collections if c.mphdrr_scanner.is_scanner and c.library is None]


def _is_busy() -> bool:
    """Return whether Blender plays an animation or renders."""
    is_playing = any(window.screen.is_animation_playing for window in bpy.context.window_manager.windows)
    return is_playing or bpy.app.is_job_running("RENDER")


def _check_order(collection: bpy.types.Collection) -> None:
    """Note a scanner's copied cameras and stray parts, and schedule tidying unless an undo brought them back."""
    disorder = module_edits.untidy_text(collection)
    properties = collection.mphdrr_scanner
    if properties.untidy != disorder:
        with following.writing():
            properties.untidy = disorder
    if _untidy_after_undo.get(collection.name) != disorder:
        _untidy_after_undo.pop(collection.name, None)
    if disorder and collection.name not in _untidy_after_undo:
        _schedule_tidying()


def _schedule_tidying() -> None:
    """Finish drags and tidy modules once no tool is running."""
    if not bpy.app.background:
        timers.schedule(_finish_and_tidy, _INTERVAL)


def _finish_and_tidy() -> float | None:
    """Finish drags and tidy modules once no tool is running, for example the move after Shift+D.

    Tidying is an undo step of its own.
    """
    global _needs_undo_step
    windows = bpy.context.window_manager.windows
    if not grabbing.is_dragging():
        for item in filter(grabbing.is_dragged, bpy.context.scene.objects):
            grabbing.finish_drag(item)
    if any(len(window.modal_operators) for window in windows) or _is_busy():
        return _INTERVAL
    if _needs_undo_step:
        _needs_undo_step = False
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message="Move Module")
    if any(c.mphdrr_scanner.untidy for c in scanner.scanners(bpy.context.scene)):
        try:
            bpy.ops.mphdrr.tidy_modules("EXEC_DEFAULT", True)
        except RuntimeError as error:
            print(f"mphDRR: {error}", file=sys.stderr)
            # What cannot be tidied is not tried again.
            _untidy_after_undo.update((c.name, c.mphdrr_scanner.untidy) for c in _local_scanners(bpy.data.collections))
    return None
