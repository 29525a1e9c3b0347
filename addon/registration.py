"""What the extension registers with Blender; the only file that imports operators and panels."""

from __future__ import annotations

import atexit
from collections.abc import Callable
from types import ModuleType
from typing import Any

import bpy

from ..operators import (
    add_map,
    add_phantom,
    dropped_files,
    edit_phantom,
    edit_volume,
    export_dataset,
    export_geometry,
    export_volume,
    import_geometry,
    import_volume,
    load_recipe,
    modules,
    render_projections,
    voxelize_objects,
)
from ..panels import design, export, geometry, phantom, projections
from . import (
    following,
    ids,
    jobs,
    live_phantoms,
    live_scanner,
    properties,
    scanner,
    selection,
    slices,
    storage,
    updates,
    volumes,
)

# Where the classes are. Those of one module are registered in the order in which they stand in it: a panel after its
# parent. Panels are drawn in the order of the work.
_OPERATORS = (
    import_geometry,
    modules,
    export_geometry,
    add_map,
    add_phantom,
    edit_phantom,
    edit_volume,
    voxelize_objects,
    import_volume,
    export_volume,
    render_projections,
    load_recipe,
    jobs,
    export_dataset,
    dropped_files,
)
_PANELS = (geometry, design, phantom, projections, export)


def _classes(module: ModuleType) -> list[type]:
    """The classes of a module that Blender registers: its `MPHDRR_...`."""
    return [cls for name, cls in vars(module).items() if name.startswith("MPHDRR_") and isinstance(cls, type)]


CLASSES: tuple[type, ...] = (
    *properties.CLASSES,
    *add_phantom.ADD_KINDS,
    *(cls for module in (*_OPERATORS, *_PANELS) for cls in _classes(module)),
)

# (menu, draw function): entries in Blender's own menus.
MENUS: tuple[tuple[Any, Any], ...] = (
    (bpy.types.TOPBAR_MT_file_import, import_geometry.draw_menu),
    (bpy.types.TOPBAR_MT_file_import, import_volume.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_geometry.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_volume.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_dataset.draw_menu),
    (bpy.types.VIEW3D_MT_add, phantom.draw_menu),
    (bpy.types.VIEW3D_MT_object_convert, voxelize_objects.draw_menu),
)

# (list in bpy.app.handlers, function): decorate the function with @bpy.app.handlers.persistent.
HANDLERS: tuple[tuple[list[Any], Any], ...] = (
    (bpy.app.handlers.load_pre, jobs.before_load),
    (bpy.app.handlers.load_pre, slices.before_load),
    (bpy.app.handlers.load_post, volumes.after_load),
    (bpy.app.handlers.load_post, live_scanner.after_load),
    (bpy.app.handlers.depsgraph_update_post, live_scanner.after_update),
    (bpy.app.handlers.frame_change_post, live_scanner.after_frame),
    (bpy.app.handlers.frame_change_post, slices.after_frame_change),
    (bpy.app.handlers.undo_post, live_scanner.after_undo),
    (bpy.app.handlers.redo_post, live_scanner.after_undo),
    (bpy.app.handlers.save_pre, storage.before_save),
    (bpy.app.handlers.save_post, storage.after_save),
    (bpy.app.handlers.save_post_fail, storage.restore_paths),
)

# What edited properties call (`addon/updates.py`).
UPDATES: dict[str, Callable[..., None]] = {
    "module": following.refresh_module,
    "length": following.length_typed,
    "visible": scanner.set_visible,
    "scanner": following.refresh,
    "all_modules": following.set_for_all,
    "active_module": selection.select_active,
    "phantom": live_phantoms.settings_changed,
    "display_range": slices.range_changed,
    "slices": slices.update,
}

# How to take back what was registered: (function, arguments).
_undo: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []


def register(command: Callable[..., int] | None = None) -> None:
    """Register everything, or, if something fails, take back what was registered and raise.

    `command` is what ``blender --command mphdrr`` calls.
    """
    updates.FUNCTIONS.update(UPDATES)
    try:
        for cls in CLASSES:
            bpy.utils.register_class(cls)
            _undo.append((bpy.utils.unregister_class, (cls,)))
        for owner, name, group in properties.POINTERS:
            setattr(owner, name, bpy.props.PointerProperty(type=group))
            _undo.append((delattr, (owner, name)))
        for menu, draw in MENUS:
            menu.append(draw)
            _undo.append((menu.remove, (draw,)))
        for handlers, function in HANDLERS:
            handlers.append(function)
            _undo.append((_remove_handler, (handlers, function)))
        if command is not None:
            registered = bpy.utils.register_cli_command(ids.PREFIX, command)
            _undo.append((bpy.utils.unregister_cli_command, (registered,)))
    except Exception:
        _take_back()
        raise
    if bpy.app.module:
        # Registered classes keep Python's bpy module alive: Blender 4.5 would wait for ever when Python ends.
        atexit.register(unregister)


def unregister() -> None:
    """Take back what `register` did, in reverse order."""
    atexit.unregister(unregister)
    jobs.stop()
    live_scanner.stop()
    live_phantoms.stop()
    _take_back()


def _take_back() -> None:
    while _undo:
        function, arguments = _undo.pop()
        function(*arguments)


def _remove_handler(handlers: list[Any], function: Any) -> None:
    if function in handlers:  # loading a file drops handlers that are not persistent
        handlers.remove(function)
