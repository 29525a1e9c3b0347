"""What the extension registers with Blender, explicitly; the only file that imports operators and panels."""

from __future__ import annotations

import atexit
from collections.abc import Callable
from typing import Any

import bpy

from ..operators import (
    add_map,
    add_phantom,
    add_slices,
    aim_modules,
    check_geometry,
    convert_ct,
    duplicate_modules,
    edit_phantom,
    export_dataset,
    export_for_program,
    export_geometry,
    export_volume,
    import_geometry,
    import_volume,
    load_recipe,
    remove_modules,
    render_projections,
    renumber_modules,
    set_numbers,
    show_modules,
    tidy_modules,
    volume_files,
    voxelize_objects,
)
from ..panels import add_menu, design, export, geometry, phantom, projections
from . import ids, jobs, live, live_phantoms, preferences, properties, slices, storage, volumes

# Classes in the order of registration; a panel comes after its parent. To add a class, list it here.
CLASSES: tuple[type, ...] = (
    *properties.CLASSES,
    preferences.MPHDRR_Preferences,
    # operators
    import_geometry.MPHDRR_OT_import_geometry,
    import_geometry.MPHDRR_FH_workbook,
    show_modules.MPHDRR_OT_show_modules,
    show_modules.MPHDRR_OT_look_through_module,
    aim_modules.MPHDRR_OT_aim_modules,
    duplicate_modules.MPHDRR_OT_duplicate_modules,
    remove_modules.MPHDRR_OT_remove_modules,
    tidy_modules.MPHDRR_OT_tidy_modules,
    renumber_modules.MPHDRR_OT_renumber_modules,
    set_numbers.MPHDRR_OT_set_numbers,
    check_geometry.MPHDRR_OT_check_geometry,
    export_geometry.MPHDRR_OT_export_geometry,
    export_for_program.MPHDRR_OT_export_for_program,
    add_map.MPHDRR_OT_add_map,
    *add_phantom.ADD_KINDS,
    add_phantom.MPHDRR_OT_import_phantom,
    add_phantom.MPHDRR_FH_phantom,
    edit_phantom.MPHDRR_OT_update_phantom,
    edit_phantom.MPHDRR_OT_update_derenzo,
    edit_phantom.MPHDRR_OT_apply_phantom_pose,
    edit_phantom.MPHDRR_OT_show_phantom_outline,
    voxelize_objects.MPHDRR_OT_voxelize_objects,
    voxelize_objects.MPHDRR_OT_mesh_from_volume,
    import_volume.MPHDRR_OT_import_volume,
    import_volume.MPHDRR_OT_import_volume_sequence,
    import_volume.MPHDRR_FH_volume,
    export_volume.MPHDRR_OT_export_volume,
    convert_ct.MPHDRR_OT_ct_to_attenuation,
    add_slices.MPHDRR_OT_add_slices,
    add_slices.MPHDRR_OT_remove_slices,
    volume_files.MPHDRR_OT_clean_volume_files,
    volume_files.MPHDRR_OT_find_volume_files,
    render_projections.MPHDRR_OT_render_projections,
    render_projections.MPHDRR_OT_show_projections,
    load_recipe.MPHDRR_OT_load_recipe,
    jobs.MPHDRR_OT_cancel_job,
    export_dataset.MPHDRR_OT_export_dataset,
    add_menu.MPHDRR_MT_add,
    # panels, in the order of the work
    geometry.MPHDRR_UL_modules,
    geometry.MPHDRR_PT_geometry,
    geometry.MPHDRR_PT_modules,
    design.MPHDRR_PT_design,
    design.MPHDRR_PT_scanner_design,
    phantom.MPHDRR_PT_phantom,
    projections.MPHDRR_PT_projections,
    projections.MPHDRR_PT_physics,
    export.MPHDRR_PT_export,
)

# (menu, draw function): entries in Blender's own menus.
MENUS: tuple[tuple[Any, Any], ...] = (
    (bpy.types.TOPBAR_MT_file_import, import_geometry.draw_menu),
    (bpy.types.TOPBAR_MT_file_import, import_volume.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_geometry.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_for_program.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_volume.draw_menu),
    (bpy.types.TOPBAR_MT_file_export, export_dataset.draw_menu),
    (bpy.types.VIEW3D_MT_add, add_menu.draw_menu),
    (bpy.types.VIEW3D_MT_object_convert, voxelize_objects.draw_menu),
)

# (list in bpy.app.handlers, function): decorate the function with @bpy.app.handlers.persistent.
HANDLERS: tuple[tuple[list[Any], Any], ...] = (
    (bpy.app.handlers.load_pre, jobs.before_load),
    (bpy.app.handlers.load_pre, slices.before_load),
    (bpy.app.handlers.load_pre, live_phantoms.before_load),
    (bpy.app.handlers.load_post, volumes.after_load),
    (bpy.app.handlers.load_post, live.after_load),
    (bpy.app.handlers.load_post, live_phantoms.after_undo),
    (bpy.app.handlers.depsgraph_update_post, live.after_update),
    (bpy.app.handlers.frame_change_post, live.after_frame),
    (bpy.app.handlers.frame_change_post, slices.after_frame_change),
    (bpy.app.handlers.undo_post, live.after_undo),
    (bpy.app.handlers.undo_post, live_phantoms.after_undo),
    (bpy.app.handlers.redo_post, live.after_undo),
    (bpy.app.handlers.redo_post, live_phantoms.after_undo),
    (bpy.app.handlers.save_pre, storage.before_save),
    (bpy.app.handlers.save_post, storage.after_save),
    (bpy.app.handlers.save_post_fail, storage.after_failed_save),
)

# What Blender gave for ``blender --command mphdrr``, to take it back with.
_commands: list[Any] = []


def register(command: Callable[..., int] | None = None) -> None:
    """Register everything, or, if something fails, undo what was done and raise.

    `command` is what ``blender --command mphdrr`` calls.
    """
    undo: list[tuple[Any, tuple[Any, ...]]] = []
    try:
        for cls in CLASSES:
            bpy.utils.register_class(cls)
            undo.append((bpy.utils.unregister_class, (cls,)))
        for owner, name, group in properties.POINTERS:
            setattr(owner, name, bpy.props.PointerProperty(type=group))
            undo.append((delattr, (owner, name)))
        for menu, draw in MENUS:
            menu.append(draw)
            undo.append((menu.remove, (draw,)))
        for handlers, function in HANDLERS:
            handlers.append(function)
            undo.append((handlers.remove, (function,)))
        if command is not None:
            _commands.append(bpy.utils.register_cli_command(ids.PREFIX, command))
    except Exception:
        for function, arguments in reversed(undo):
            function(*arguments)
        raise
    if bpy.app.module:
        # Registered classes keep Python's bpy module alive, so that Blender 4.5 waits for ever when Python ends.
        atexit.register(unregister)


def unregister() -> None:
    """Take back what `register` did, in reverse order."""
    atexit.unregister(unregister)
    jobs.stop()
    live.stop()
    live_phantoms.stop()
    while _commands:
        bpy.utils.unregister_cli_command(_commands.pop())
    for handlers, function in reversed(HANDLERS):
        if function in handlers:  # loading a file drops handlers that are not persistent
            handlers.remove(function)
    for menu, draw in reversed(MENUS):
        menu.remove(draw)
    for owner, name, _ in reversed(properties.POINTERS):
        delattr(owner, name)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
