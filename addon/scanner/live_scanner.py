"""Handlers: scanners follow when cameras move, after undo and redo, and when a file is loaded.

Cameras that the user copied or deleted with Blender's own Shift+D and X need datablocks made and removed: that waits until
Blender is idle, and is an undo step of its own. What an undo has made untidy again is left so; the panel offers to tidy it.
"""

import sys
from collections.abc import Iterable
from typing import Any

import bpy

from ..blender import timers
from . import following, grabbing, module_edits, scanner

_INTERVAL = 0.2  # s between two looks whether a tool is still running
_overlooked = False  # something happened while rendering or playing
_unstored = False  # modules have moved and no undo step has it
_undone: dict[str, str] = {}  # by scanner: what the last undo left untidy, in words


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Blender has evaluated the scene: modules that moved are rebuilt."""
    _follow(scene, depsgraph, aim=True)


def after_frame(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """The frame has changed: modules that an animation moved are rebuilt, and keep the aim that it gives them."""
    _follow(scene, depsgraph, aim=False)


def _follow(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, aim: bool) -> None:
    global _overlooked
    if depsgraph.mode != "VIEWPORT" or following.is_writing():
        return
    # Both when objects were added, deleted, shown or hidden; selecting is an update of the scene alone.
    structure = _overlooked or (depsgraph.id_type_updated("SCENE") and depsgraph.id_type_updated("COLLECTION"))
    updates = [u for u in depsgraph.updates if u.id.id_type == "OBJECT"]
    placed = [u.id.original for u in updates if u.is_updated_transform]
    # Blender does not say that an animation or a driver has changed a module's number: the animated are looked at.
    animated = [u.id.original for u in updates if u.id.animation_data is not None]
    moved = {item for item in placed if item.mphdrr_module.is_module and following.has_moved(item)}
    moved |= {item for item in animated if item.mphdrr_module.is_module}
    off = [
        item for item in (scene.objects if _overlooked else placed) if grabbing.is_part(item) and grabbing.is_off(item)
    ]
    if not (moved or off or structure):
        return
    everything, _overlooked = _overlooked, _is_busy()
    if _overlooked:
        return
    moved |= _carry(off)
    for collection in _local(scanner.scanners(scene)):
        own = [camera for camera in moved if collection.all_objects.get(camera.name) == camera]
        if structure:
            own = [o for o in scanner.modules(collection) if everything or o in moved or following.has_moved(o)]
        following.refresh(collection, own, aim)
        if structure:
            _look_for_copies(collection)


def _carry(off: list[bpy.types.Object]) -> set[bpy.types.Object]:
    """Modules follow their parts that are `off`; returns their cameras."""
    global _unstored
    dragging = grabbing.is_dragging()
    # Blender stores an undo step when a drag ends; what a script moved was stored before the cameras followed.
    _unstored |= bool(off) and not dragging and not all(map(grabbing.is_dragged, off))
    carried = grabbing.carry(off, dragging)
    if off:
        _settle_later()
    return carried


def after_undo(*_: Any) -> None:
    """Undo and redo restore some datablocks and leave others: make everything agree again."""
    global _unstored
    _undone.clear()
    _unstored = False
    for item in filter(grabbing.is_part, bpy.data.objects):
        if grabbing.is_dragged(item):
            grabbing.finish(item)
        elif grabbing.is_off(item):  # in the undo step its camera has not followed yet: so it has not moved
            grabbing.put_back(item)
    for collection in _local(bpy.data.collections):
        following.refresh(collection)
        with following.writing():
            collection.mphdrr_scanner.untidy = module_edits.untidy_text(collection)
        _undone[collection.name] = collection.mphdrr_scanner.untidy


def after_load(*_: Any) -> None:
    """A file was opened; one of an older version has shared meshes and no readouts. Nothing is tidied unasked."""
    for collection in _local(bpy.data.collections):
        module_edits.make_single_users(collection)
        if not collection.mphdrr_scanner.parts_free:
            for item in filter(grabbing.is_part, collection.all_objects):
                item.lock_location = item.lock_rotation = (False, False, False)
            collection.mphdrr_scanner.parts_free = True
    after_undo()


def _local(collections: Iterable[bpy.types.Collection]) -> list[bpy.types.Collection]:
    """The scanners that are not linked from another file."""
    return [c for c in collections if c.mphdrr_scanner.is_scanner and c.library is None]


def _is_busy() -> bool:
    playing = any(window.screen.is_animation_playing for window in bpy.context.window_manager.windows)
    return playing or bpy.app.is_job_running("RENDER")


def _look_for_copies(collection: bpy.types.Collection) -> None:
    text = module_edits.untidy_text(collection)
    properties = collection.mphdrr_scanner
    if properties.untidy != text:
        with following.writing():
            properties.untidy = text
    if _undone.get(collection.name) != text:
        _undone.pop(collection.name, None)
    if text and collection.name not in _undone:
        _settle_later()


def _settle_later() -> None:
    if not bpy.app.background:
        timers.schedule(_settle, _INTERVAL)


def _settle() -> float | None:
    """Finish and tidy once no tool is running, e.g. the move that follows Shift+D. Tidying is an undo step."""
    global _unstored
    windows = bpy.context.window_manager.windows
    if not grabbing.is_dragging():
        for item in filter(grabbing.is_dragged, bpy.context.scene.objects):
            grabbing.finish(item)
    if any(len(window.modal_operators) for window in windows) or _is_busy():
        return _INTERVAL
    if _unstored:
        _unstored = False
        with bpy.context.temp_override(window=windows[0]):
            bpy.ops.ed.undo_push(message="Move Module")
    if any(c.mphdrr_scanner.untidy for c in scanner.scanners(bpy.context.scene)):
        try:
            bpy.ops.mphdrr.tidy_modules("EXEC_DEFAULT", True)
        except RuntimeError as error:
            print(f"mphDRR: {error}", file=sys.stderr)
            # Not again and again:
            _undone.update((c.name, c.mphdrr_scanner.untidy) for c in _local(bpy.data.collections))
    return None
