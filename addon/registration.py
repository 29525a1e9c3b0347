"""Registration of the extension with Blender; the only file that imports operators and panels."""

import atexit
import importlib
import inspect
import pkgutil
from collections.abc import Callable
from contextlib import ExitStack
from types import ModuleType
from typing import Any

import bpy

from .. import operators, panels
from ..operators import add_phantom
from ..panels import menus
from . import preferences, properties, recovery
from .blender import ids, jobs, layouts, plots, storage, timers, updates
from .events import event_notes
from .figures import figures
from .perspective import color_bar, epipolar_drawing, frustums
from .phantoms import live_phantoms
from .pictures import images, planes, recoloring, tiles
from .runs import preview, rendering, run_notes, runs
from .scanner import following, framing, live_scanner, scanner, selection, sight_lines
from .volumes import slices, volumes


def _classes(module: ModuleType) -> list[Any]:
    """Return the classes that Blender registers, `MPHDRR_...`, of a module or of all modules of a package."""
    if hasattr(module, "__path__"):
        names = [f"{module.__name__}.{info.name}" for info in pkgutil.iter_modules(module.__path__)]
        return [cls for name in names for cls in _classes(importlib.import_module(name))]
    classes = [cls for name, cls in vars(module).items() if name.startswith("MPHDRR_") and isinstance(cls, type)]
    return [cls for cls in classes if cls.__module__ == module.__name__]


CLASSES: tuple[Any, ...] = (
    *properties.CLASSES,
    *_classes(preferences),
    *add_phantom.ADD_KINDS,
    *_classes(operators),
    *_classes(jobs),
    *sorted(_classes(panels), key=lambda cls: hasattr(cls, "bl_parent_id")),  # a panel after its parent
)

# Entries in Blender's own menus: texts by operator.
ENTRIES = {
    bpy.types.TOPBAR_MT_file_import: {
        "mphdrr.import_geometry": "Pinhole Geometry (.xlsx)",
        "mphdrr.import_volume": "Volume for Projection (.nii, DICOM, .nrrd, .vdb, ...)",
        "mphdrr.import_volume_sequence": "Volume Sequence (.nii, .nrrd, .vdb, ...)",
        "mphdrr.import_counts": "Measured Counts (.npy, .h5, DICOM, .mhd, .hdr, ...)",
    },
    bpy.types.TOPBAR_MT_file_export: {
        "mphdrr.export_geometry": "Pinhole Geometry (.xlsx)",
        "mphdrr.export_for_program": "Pinhole Geometry for Programs",
        "mphdrr.export_volume": "Volume (.vdb, .nii, .nrrd, ...)",
        "mphdrr.export_dataset": "mphDRR Dataset (.h5/.npz/.pt)",
        "mphdrr.export_figure": "mphDRR Figure (.png/.svg)",
    },
    bpy.types.TOPBAR_MT_file_external_data: {"mphdrr.collect_files": "Collect mphDRR's Files Beside the .blend"},
    bpy.types.VIEW3D_MT_object_convert: {
        "mphdrr.voxelize_objects": "Voxelize Meshes",
        "mphdrr.mesh_from_volume": "Mesh from Volume",
    },
}


def _draw_entries(entries: dict[str, str]) -> Callable[..., None]:
    """Return a function that draws entries of a menu."""

    def draw(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
        layout = layouts.invoking(menu.layout)
        for operator, text in entries.items():
            layout.operator(operator, text=text)

    return draw


# The extension's menus in Blender's own: name, text, icon.
SUBMENUS = {
    bpy.types.VIEW3D_MT_add: ("MPHDRR_MT_add", "mphDRR", "OUTLINER_DATA_VOLUME"),
    bpy.types.VIEW3D_MT_object: ("MPHDRR_MT_commands", "mphDRR", "OUTLINER_OB_CAMERA"),
    bpy.types.IMAGE_MT_image: ("MPHDRR_MT_projections", "mphDRR Projections", "RENDER_STILL"),
}


def _draw_submenu(name: str, text: str, icon: str) -> Callable[..., None]:
    """Return a function that draws an entry which opens a menu."""
    return lambda menu, context: menu.layout.menu(name, text=text, icon=icon)


def _draw_splash(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    """Draw the example's entry in the splash screen.

    An extension cannot bring an application template: Blender looks for these in its own folders only.
    """
    layouts.invoking(menu.layout).operator("mphdrr.load_example", text="mphDRR Example", icon="PLAY")
    menu.layout.separator()


MENUS = [(menu, _draw_entries(entries)) for menu, entries in ENTRIES.items()]
MENUS += [(bpy.types.STATUSBAR_HT_header, draw) for draw in (storage.draw_save_note, jobs.draw_status)]
MENUS += [(menu, _draw_submenu(*submenu)) for menu, submenu in SUBMENUS.items()]
MENUS.append((bpy.types.WM_MT_splash, _draw_splash))
CONTEXT_MENUS = bpy.types.VIEW3D_MT_object_context_menu, bpy.types.OUTLINER_MT_object
MENUS += [(menu, menus.draw_in_context_menu) for menu in CONTEXT_MENUS]

_BEFORE_UNDO = (framing.before_undo, images.before_undo)
_AFTER_UNDO = (recoloring.check, runs.after_update, live_scanner.after_undo, slices.after_undo, framing.after_undo)
_AFTER_UPDATE = (
    live_scanner.after_update, selection.after_update, planes.after_update, frustums.after_update, slices.after_update,
)  # fmt: skip
_AFTER_LOAD = (
    storage.after_load, volumes.after_load, recovery.after_load, live_scanner.after_load, runs.after_load, recoloring.check,
)  # fmt: skip
_AFTER_FRAME = (runs.after_update, live_scanner.after_frame, preview.after_update, slices.after_frame_change)
# Functions by list of `bpy.app.handlers`; all of them stay when a file is loaded.
_HANDLERS: dict[str, tuple[Any, ...]] = {
    "load_pre": (jobs.stop, slices.before_load, preview.stop, framing.forget),
    "load_post": _AFTER_LOAD,
    "depsgraph_update_post": (*_AFTER_UPDATE, runs.after_update, preview.after_update),
    "frame_change_post": _AFTER_FRAME,
    "undo_pre": _BEFORE_UNDO,
    "redo_pre": _BEFORE_UNDO,
    "undo_post": (images.after_undo, *_AFTER_UNDO, preview.after_update),
    "redo_post": (images.after_undo, *_AFTER_UNDO, preview.after_update),
    "render_init": (figures.before_render,),
    "save_pre": (storage.before_save, slices.before_save),
    "save_post": (storage.after_save,),
    "save_post_fail": (storage.restore_paths,),
}
HANDLERS = tuple(
    (getattr(bpy.app.handlers, name), bpy.app.handlers.persistent(function))
    for name, functions in _HANDLERS.items()
    for function in functions
)

# Functions that draw over Blender's editors, where there is a window.
DRAWINGS = (
    (bpy.types.SpaceImageEditor, tiles.draw, "POST_PIXEL"),
    (bpy.types.SpaceImageEditor, epipolar_drawing.draw_over_pictures, "POST_PIXEL"),
    (bpy.types.SpaceImageEditor, run_notes.draw, "POST_PIXEL"),
    (bpy.types.SpaceView3D, color_bar.draw, "POST_PIXEL"),
    (bpy.types.SpaceView3D, sight_lines.draw, "POST_VIEW"),
    (bpy.types.SpaceView3D, epipolar_drawing.draw_in_scene, "POST_VIEW"),
)


def _modules_removed(scene: bpy.types.Scene, modules: list[bpy.types.Object]) -> None:
    """Remove projections of modules from a scene, and volumes in the modules' coordinates."""
    planes.remove(scene, modules)
    frustums.remove(scene, modules)


# Functions that edited properties and lower rooms call (`addon/blender/updates.py`).
UPDATES: dict[str, Callable[..., None]] = {
    "module": following.refresh_module,
    "length": following.keep_typed_length,
    "visible": scanner.set_visible,
    "scanner": following.refresh,
    "all_modules": following.set_for_all,
    "active_module": selection.select_active,
    "scanner_chosen": selection.scanner_chosen,
    "phantom": live_phantoms.settings_changed,
    "display_range": slices.update,
    "slices": slices.update,
    "look": slices.look_changed,
    "sight_lines": sight_lines.redraw,
    "display": recoloring.display_changed,
    "planes": planes.edited,
    "epipolar": epipolar_drawing.redraw,
    "active_run": rendering.active_run_changed,
    "modules_removed": _modules_removed,
}

_OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}
_registered = ExitStack()  # undoes the registration, in reverse order


def register(command: Callable[..., int] | None = None) -> None:
    """Register everything, or nothing if something fails; `command` is the function of ``blender --command mphdrr``."""
    updates.FUNCTIONS.update(UPDATES)
    properties.add_columns()
    try:
        for cls in CLASSES:
            _complete(cls)
            bpy.utils.register_class(cls)
            _registered.callback(bpy.utils.unregister_class, cls)
        for owner, name, group in properties.POINTERS:
            setattr(owner, name, bpy.props.PointerProperty(type=group, override=_OVERRIDABLE))
            _registered.callback(delattr, owner, name)
        preferences.apply()
        for menu, draw in MENUS:
            menu.append(draw)
            _registered.callback(menu.remove, draw)
        for handlers, function in HANDLERS:
            handlers.append(function)
            _registered.callback(_remove_handler, handlers, function)
        if not bpy.app.background:
            for space, draw, draw_type in DRAWINGS:
                drawing = space.draw_handler_add(draw, (), "WINDOW", draw_type)
                _registered.callback(space.draw_handler_remove, drawing, "WINDOW")
            keymaps = bpy.context.window_manager.keyconfigs.addon.keymaps
            for name in ("Image", "Image Editor Tool: Sample"):  # the latter takes clicks before "Image" does
                keymap = keymaps.new(name, space_type="IMAGE_EDITOR")
                click = keymap.keymap_items.new("mphdrr.pick_module", "LEFTMOUSE", "PRESS")
                _registered.callback(keymap.keymap_items.remove, click)
            keymap = keymaps.new(preferences.PIE_KEYMAP)
            key = keymap.keymap_items.new("wm.call_menu_pie", "Q", "PRESS", shift=True)
            key.properties.name = preferences.PIE
            _registered.callback(keymap.keymap_items.remove, key)
        if command is not None:
            _registered.callback(bpy.utils.unregister_cli_command, bpy.utils.register_cli_command(ids.PREFIX, command))
    except Exception:
        _registered.close()
        raise
    if bpy.app.module:
        # Registered classes keep Python's bpy module alive: Blender 4.5 would never finish when Python ends.
        atexit.register(unregister)


def _complete(cls: Any) -> None:
    """Give a class the label, idname and tooltip that follow from its name and docstring, unless it has its own.

    Library overrides keep the properties of a property group.
    """
    if cls.__name__.startswith("MPHDRR_"):
        cls.bl_label = getattr(cls, "bl_label", ids.label(cls.__name__))
    if issubclass(cls, bpy.types.Operator):
        cls.bl_idname = vars(cls).get("bl_idname", ids.operator_name(cls.__name__))
    if issubclass(cls, (bpy.types.Operator, bpy.types.Panel)) and cls.__doc__ is not None:
        cls.bl_description = " ".join(cls.__doc__.split()).removesuffix(".")  # Blender keeps line breaks
    for base in cls.__mro__ if issubclass(cls, bpy.types.PropertyGroup) else ():
        if annotations := inspect.get_annotations(base, eval_str=True):
            for annotation in annotations.values():
                getattr(annotation, "keywords", {}).setdefault("override", _OVERRIDABLE)
            base.__annotations__ = annotations


def unregister() -> None:
    """Undo `register`."""
    atexit.unregister(unregister)
    for module in (jobs, preview, plots, recoloring, event_notes, timers):
        module.stop()
    _registered.close()


def _remove_handler(handlers: list[Any], function: Any) -> None:
    """Remove a handler that may already be gone."""
    if function in handlers:  # loading a file drops handlers that are not persistent
        handlers.remove(function)
