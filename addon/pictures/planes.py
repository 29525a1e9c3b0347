"""Projections where they belong: as planes between each pinhole and the ROI, and over what its camera sees.

A plane is an image empty, a child of its module's camera, in a collection of its own. It faces the ROI only: whoever
looks through the camera sees the scene, and the picture over it as the camera's background image.
"""

import math

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...core import ProjectionRun
from ..blender import ids, objects
from ..scanner import grabbing, scanner, selection
from . import images

_KEY = "mphdrr_field"
"""Custom property of a plane: middle and size (5,) of the virtual detector in the camera's frame, mm."""
_NEAR = 1e-5  # rounding
_BETWEEN = 0.3  # of the way from the pinhole to the ROI's surface: where a plane is by default


def make(scene: bpy.types.Scene, run: ProjectionRun, collection: bpy.types.Collection | None) -> list[bpy.types.Object]:
    """Show the pictures of a run (`images.storing`) at the modules of its scanner, in place of another run's.

    Modules that the scanner does not have any more get none.
    """
    for each in bpy.data.scenes:  # the images are those of this run now, also where another scene's planes show them
        if each != scene or collection is None:
            remove(each)
    if collection is None:
        return []
    old = {plane.parent: plane for plane in planes(scene)}  # used again: Blender need not sort the scene's objects anew
    home = objects.ensure_collection(scene, ids.PLANES)
    cameras = {camera.mphdrr_module.number: camera for camera in scanner.modules(collection)}
    made = []
    numbers = run.system.numbers.tolist()
    for number, field in zip(numbers, run.views.fields(run.system.poses()), strict=True):
        if number not in cameras:
            continue
        camera = cameras[number]
        picture = bpy.data.images[ids.picture_name(images.projection_name(number, numbers))]
        plane = old.pop(camera, None)
        if plane is None:
            plane = objects.picture_empty(ids.part_name(camera.name, "projection"), camera, picture, "BACK")
            plane.lock_scale = (True, True, True)
            plane.mphdrr_module.part, plane.mphdrr_module.number = "PLANE", number
            home.objects.link(plane)
        else:
            _remove_background(camera.data, plane.data)
        plane.data, plane[_KEY] = picture, field.tolist()
        _set_background(camera.data, field, picture)
        made.append(plane)
    for plane in old.values():
        _remove(plane)
    update(scene)
    return made


def planes(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The planes in the scene."""
    return [o for home in objects.collections_named(scene, ids.PLANES) for o in home.objects if _KEY in o]


def remove(scene: bpy.types.Scene, modules: list[bpy.types.Object] | None = None) -> None:
    """Remove the planes and the backgrounds of modules (their cameras), or of all."""
    for plane in planes(scene):
        if modules is None or plane.parent in modules:
            _remove(plane)
    objects.remove_empty_collections(scene, ids.PLANES)


def _remove(plane: bpy.types.Object) -> None:
    if plane.parent is not None:
        _remove_background(plane.parent.data, plane.data)
    bpy.data.objects.remove(plane)


def update(scene: bpy.types.Scene) -> None:
    """Place and show the planes and backgrounds as the scene's settings say."""
    settings = scene.mphdrr_display
    part = images.share_shown()
    for plane, shown in _wanted(scene):
        objects.change(plane, hide_viewport=not shown)
        if plane.parent is None:
            continue
        _place(plane, settings, part)
        plane.color[3] = settings.plane_opacity
        for background in _backgrounds(plane):
            background.show_background_image = settings.backgrounds
            background.alpha = settings.plane_opacity


def _place(plane: bpy.types.Object, settings: bpy.types.PropertyGroup, part: tuple[float, float]) -> None:
    """Put a plane where it belongs on its camera, and the background where the camera sees it."""
    field = np.array(plane[_KEY])
    x, y, depth, width, height = field * share_of_way(settings, plane.parent.mphdrr_module, field[2])
    width, height = width * part[0], height * part[1]
    # A picture's longer side is as long as the empty; pixels that are not square are stretched.
    columns, rows = plane.data.size
    plane.empty_display_size = max(columns, rows)
    grabbing.set_home(plane, Matrix.LocRotScale((x, y, -depth), None, (width / columns, height / rows, 1.0)))
    _place_background(plane, part[0])


def _place_background(plane: bpy.types.Object, share: float) -> None:
    """Make the picture over the camera's view as large as what it shows is seen there."""
    camera, (x, y, depth, width, _) = plane.parent.data, plane[_KEY]
    seen = camera.sensor_width / camera.lens * depth  # how much the camera sees there
    scale = share * abs(width) / seen
    for background in _backgrounds(plane):
        if not math.isclose(background.scale, scale, rel_tol=_NEAR):  # writing is an update of the scene
            background.scale, background.offset = scale, (x / seen, y / seen)


def _backgrounds(plane: bpy.types.Object) -> list[bpy.types.CameraBackgroundImage]:
    """The backgrounds of the plane's camera that show its picture."""
    return [found for found in plane.parent.data.background_images if found.image == plane.data]


def share_of_way(settings: bpy.types.PropertyGroup, module: bpy.types.PropertyGroup, distance: float) -> float:
    """Where a module's picture is shown: as a share of the way from its pinhole to the detector at `distance`, mm."""
    if settings.plane_at_detector:
        return 1.0
    return (settings.plane_distance or _BETWEEN * (module.pinhole_distance - module.roi_radius)) / distance


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Another module is active, modules were shown or hidden, or `l` was edited: planes and backgrounds follow."""
    if depsgraph.id_type_updated("SCENE") and scene == bpy.context.scene:
        for plane, shown in _wanted(scene):
            objects.change(plane, hide_viewport=not shown)
    changed = {selection.module_of(each.id.original) for each in depsgraph.updates if each.id.id_type == "OBJECT"}
    changed.discard(None)
    if changed:
        share = images.share_shown()[0]
        for plane in planes(scene):
            if plane.parent in changed:
                _place_background(plane, share)


def _wanted(scene: bpy.types.Scene) -> list[tuple[bpy.types.Object, bool]]:
    """The planes, each with whether it is to be shown: not without its module, which was deleted."""
    mode = scene.mphdrr_display.planes
    active = selection.active_module(bpy.context) if mode in ("ACTIVE", "RING") else None
    ring = None if active is None else active.mphdrr_module.ring

    def shown(camera: bpy.types.Object | None) -> bool:
        if camera is None or camera.hide_viewport or mode == "NONE":
            return False
        return mode == "ALL" or camera == active or (mode == "RING" and camera.mphdrr_module.ring == ring)

    return [(plane, shown(plane.parent)) for plane in planes(scene) if plane.data is not None]


def _set_background(camera: bpy.types.Camera, field: NDArray[np.float64], picture: bpy.types.Image) -> None:
    """Lay a picture over a camera's view."""
    background = camera.background_images.new()
    background.image = picture
    background.frame_method, background.display_depth = "STRETCH", "FRONT"
    background.use_flip_x, background.use_flip_y = bool(field[3] < 0), bool(field[4] < 0)
    camera.show_background_images = True


def _remove_background(camera: bpy.types.Camera, picture: bpy.types.Image | None) -> None:
    for background in list(camera.background_images):
        if background.image == picture:
            camera.background_images.remove(background)
