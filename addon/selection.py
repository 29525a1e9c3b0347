"""Which modules an operator or a panel works on: the active one and the selected ones."""

from collections.abc import Iterable
from typing import Any

import bpy

from . import following, images, scanner
from .reports import polled, run_reported


def active_module(context: bpy.types.Context) -> bpy.types.Object | None:
    """The camera of the active scanner's module that is active in the viewport (or a part of it is), else in the list."""
    collection = scanner.active_scanner(context.scene)
    if collection is None:
        return None
    item = module_of(context.view_layer.objects.active)
    if item is not None and item.name in collection.all_objects:
        return item
    return listed_module(context.scene)


def listed_module(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The camera of the module that is active in the panel's list."""
    collection, index = scanner.active_scanner(scene), scene.mphdrr_geometry.active_index
    camera = collection.all_objects[index] if collection and 0 <= index < len(collection.all_objects) else None
    return camera if camera is not None and camera.mphdrr_module.is_module else None


def selected_modules(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Cameras of the active scanner's modules that are selected (or a part of them is), in order; else the active one."""
    collection = scanner.active_scanner(context.scene)
    if collection is None:
        return []
    chosen = {module_of(item) for item in context.view_layer.objects if item.select_get(view_layer=context.view_layer)}
    active = active_module(context)
    return [o for o in scanner.modules(collection) if o in chosen] or ([active] if active else [])


def module_of(item: bpy.types.Object | None) -> bpy.types.Object | None:
    """The camera of the module that an object is or belongs to; None for other objects."""
    if item is not None and not item.mphdrr_module.is_module and item.mphdrr_module.part != "NONE":
        item = item.parent
    return item if item is not None and item.mphdrr_module.is_module else None


def select(context: bpy.types.Context, modules: Iterable[bpy.types.Object]) -> None:
    """Select those of these modules' cameras that are visible, and nothing else; the first becomes active."""
    if context.mode != "OBJECT":
        return
    layer = context.view_layer
    for item in layer.objects:
        if item.select_get(view_layer=layer):
            item.select_set(False, view_layer=layer)
    shown = [o for o in modules if o.name in layer.objects and o.visible_get(view_layer=layer)]
    for camera in shown:
        camera.select_set(True, view_layer=layer)
    if shown:
        layer.objects.active = shown[0]


@bpy.app.handlers.persistent
def after_update(scene: bpy.types.Scene, *_: Any) -> None:
    """Another module was made active in the viewport: the list and the mosaic follow."""
    camera = module_of(bpy.context.view_layer.objects.active)
    collection = scanner.active_scanner(scene)
    if camera is None or collection is None or camera == listed_module(scene):
        return
    index = collection.all_objects.find(camera.name)
    if index >= 0:
        with following.writing():
            scene.mphdrr_geometry.active_index = index
        images.redraw_mosaic()


def select_active(scene: bpy.types.Scene) -> None:
    """Select the module that is active in the panel's list, as a click on its camera would."""
    camera = listed_module(scene)
    if following.is_writing():  # the list follows the viewport
        return
    if camera is not None and camera.visible_get(view_layer=bpy.context.view_layer):
        select(bpy.context, [camera])


class NeedsScanner:
    """Mix into an operator that needs a scanner."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        """There is a scanner."""
        has_scanner = scanner.active_scanner(context.scene) is not None
        return polled(cls, has_scanner, "No scanner in the scene: import a geometry first")


class OnScanner(NeedsScanner):
    """Mix into an operator that works on the scanner of the panels."""

    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the work and report."""
        return run_reported(self, lambda: self.change(context, scanner.required_scanner(context.scene)))

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        """Do the work and return the line to report; raises InputError."""
        raise NotImplementedError


class OnModules(OnScanner):
    """Mix into an operator that works on the active or selected modules."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        """There is a scanner, and a module of it is active or selected."""
        need = "No module is selected: select a module's camera"
        return super().poll(context) and polled(cls, bool(selected_modules(context)), need)
