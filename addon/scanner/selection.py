"""Modules that an operator or a panel works on: the active one and the selected ones."""

from collections.abc import Iterable

import bpy

from ..blender import objects, reports, windows
from . import following, scanner

SCANNER: reports.Need = (
    lambda context: scanner.active_scanner(context.scene) is not None,
    "No scanner in the scene: import a geometry first",
)
"""Requirement of an operator: there is a scanner."""


def active_module(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the camera of the module that is active in the viewport, or whose part is; else that of the panel's list."""
    if (collection := scanner.active_scanner(context.scene)) is None:
        return None
    item = module_of(context.view_layer.objects.active)
    if item is not None and item.name in collection.all_objects:
        return item
    return listed_module(context.scene)


def listed_module(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the camera of the module that is active in the panel's list; None if there is none."""
    collection, index = scanner.active_scanner(scene), scene.mphdrr_geometry.active_index
    camera = collection.all_objects[index] if collection and 0 <= index < len(collection.all_objects) else None
    return camera if camera is not None and camera.mphdrr_module.is_module else None


def selected_modules(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the cameras of the active scanner's selected modules (or of selected parts), in order; else the active one."""
    if (collection := scanner.active_scanner(context.scene)) is None:
        return []
    selected = {module_of(item) for item in context.view_layer.objects.selected}
    active = active_module(context)
    return [o for o in scanner.modules(collection) if o in selected] or ([active] if active else [])


def module_of(item: bpy.types.Object | None) -> bpy.types.Object | None:
    """Return the camera of the module that an object is or belongs to; None for other objects."""
    if item is not None and not item.mphdrr_module.is_module and item.mphdrr_module.part != "NONE":
        item = item.parent
    return item if item is not None and item.mphdrr_module.is_module else None


def select(context: bpy.types.Context, modules: Iterable[bpy.types.Object]) -> None:
    """Select the visible ones of these modules' cameras, and nothing else; the first becomes active."""
    if context.mode != "OBJECT":
        return
    layer = context.view_layer
    for item in list(layer.objects.selected):
        item.select_set(False, view_layer=layer)
    visible = [o for o in modules if o.name in layer.objects and o.visible_get(view_layer=layer)]
    for camera in visible:
        camera.select_set(True, view_layer=layer)
    if visible:
        layer.objects.active = visible[0]


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Make the panels' scanner, the list and the mosaic follow when another object becomes active in the viewport."""
    if not depsgraph.id_type_updated("SCENE") or scene != bpy.context.scene:
        return
    _show_panels(scene)
    item = bpy.context.view_layer.objects.active
    camera = module_of(item)
    collection = scanner.scanner_of(scene, camera or item)
    if collection is None:
        return
    if collection != scanner.active_scanner(scene) or (camera is not None and camera != listed_module(scene)):
        with following.writing():
            if scene.mphdrr_geometry.scanner != collection:  # writing makes Blender search all objects
                scene.mphdrr_geometry.scanner = collection
            activate_in_list(scene, camera or next(iter(scanner.modules(collection)), None))
        windows.redraw("IMAGE_EDITOR")  # the mosaic has a frame around the active module's image


def _show_panels(scene: bpy.types.Scene) -> None:
    """Show of all X-ray panels only the active source's: together they would hide everything."""
    active = active_module(bpy.context)
    for collection in scanner.scanners(scene):
        for item in () if scanner.sees_activity(collection) else list(collection.all_objects):  # hiding changes these
            if item.mphdrr_module.part == "PANEL" and item.parent is not None:
                objects.change(item, hide_viewport=item.parent.hide_viewport or item.parent != active)


def scanner_chosen(scene: bpy.types.Scene) -> None:
    """Make the first module of a scanner active that was chosen in the panel."""
    if (collection := scanner.active_scanner(scene)) is not None and not following.is_writing():
        activate_in_list(scene, next(iter(scanner.modules(collection)), None))


def activate_in_list(scene: bpy.types.Scene, camera: bpy.types.Object | None) -> None:
    """Make a module active in the panel's list."""
    collection = scanner.active_scanner(scene)
    if camera is not None and collection is not None:
        scene.mphdrr_geometry.active_index = collection.all_objects.find(camera.name)


def select_active(scene: bpy.types.Scene) -> None:
    """Select the module that is active in the panel's list, as a click on its camera would."""
    camera, layer = listed_module(scene), bpy.context.view_layer
    if camera is None or following.is_writing():  # no selection while the list follows the viewport
        return
    if camera.visible_get(view_layer=layer):
        select(bpy.context, [camera])
    elif camera.name in layer.objects and bpy.context.mode == "OBJECT":  # else the list would follow the viewport again
        layer.objects.active = camera


class OnScanner(reports.Reported):
    """Mix-in of an operator that works on the scanner of the panels."""

    poll = reports.needs(SCANNER)

    def act(self, context: bpy.types.Context) -> str:
        """Do the work on the scanner."""
        return self.change(context, scanner.required_scanner(context.scene))

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        """Do the work and return the line to report, or raise `InputError`."""
        raise NotImplementedError


class OnModules(OnScanner):
    """Mix-in of an operator that works on the active or selected modules."""

    poll = reports.needs(SCANNER, (selected_modules, "No module is selected: select a module's camera"))
