"""Projections placed in the scene: as planes between each pinhole and the ROI, and as background images of the cameras.

A plane is an image empty, a child of its module's camera, in a collection of its own. It faces the ROI only: whoever
looks through the camera sees the scene, and over it the same picture as the camera's background image.
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
"""Custom property of a plane: centre and size (5,) of the virtual detector, or just before a panel, in camera space, mm."""
_ROUNDING = 1e-5  # relative rounding of a background's scale
_BEFORE_PANEL = 0.99  # relative distance of a plane at a panel, whose own face would hide it
_DEFAULT_SHARE = 0.3  # a plane's default distance from the pinhole, as a share of the distance to the ROI's surface


def show(scene: bpy.types.Scene, run: ProjectionRun, collection: bpy.types.Collection | None) -> list[bpy.types.Object]:
    """Show the pictures of a run (`images.store_images`) at the modules of its scanner, in place of another run's.

    Modules that the scanner does not have any more get none.
    """
    for other_scene in bpy.data.scenes:  # also another scene's planes would show this run's images
        if other_scene != scene or collection is None:
            remove(other_scene)
    if collection is None:
        return []
    old = {plane.parent: plane for plane in planes(scene)}  # reused, so that Blender need not sort all objects anew
    planes_collection = objects.ensure_collection(scene, ids.PLANES)
    cameras = {camera.mphdrr_module.number: camera for camera in scanner.modules(collection)}
    shown_planes = []
    numbers = run.system.numbers.tolist()
    for number, field in zip(numbers, run.views.fields(run.system.poses()), strict=True):
        if number not in cameras:
            continue
        camera = cameras[number]
        picture = bpy.data.images[ids.picture_name(images.projection_name(number, numbers))]
        if (plane := old.pop(camera, None)) is None:
            plane = objects.picture_empty(ids.part_name(camera.name, "projection"), camera, picture, "BACK")
            plane.lock_scale = (True, True, True)
            plane.mphdrr_module.part, plane.mphdrr_module.number = "PLANE", number
            planes_collection.objects.link(plane)
        else:
            _remove_backgrounds(plane)
        plane.data, plane[_KEY] = picture, (field * (1.0 if "activity" in run.system.takes else _BEFORE_PANEL)).tolist()
        _set_background(camera.data, field, picture)
        shown_planes.append(plane)
    _remove(list(old.values()))
    edited(scene)
    return shown_planes


def planes(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the planes in the scene."""
    return [o for collection in objects.collections_named(scene, ids.PLANES) for o in collection.objects if _KEY in o]


def remove(scene: bpy.types.Scene, modules: list[bpy.types.Object] | None = None) -> None:
    """Remove the planes and the backgrounds of modules, given as cameras, or of all."""
    _remove([plane for plane in planes(scene) if modules is None or plane.parent in modules])
    objects.remove_empty_collections(scene, ids.PLANES)


def edited(scene: bpy.types.Scene) -> None:
    """Show the planes as the scene's settings say after an edit of these; a reconstruction has hidden them."""
    for plane in planes(scene):
        plane.hide_set(False, view_layer=scene.view_layers[0])
    update(scene)


def _remove(unwanted: list[bpy.types.Object]) -> None:
    """Remove planes and their backgrounds."""
    for plane in unwanted:
        _remove_backgrounds(plane)
    bpy.data.batch_remove(unwanted)  # their pictures stay, which may be the user's
    objects.update_hidden_scenes()


def update(scene: bpy.types.Scene) -> None:
    """Place, show or hide the planes and backgrounds as the scene's settings say."""
    settings = scene.mphdrr_display
    fractions = images.shown_fraction()
    for plane, is_shown in _visibility(scene):
        objects.change(plane, hide_viewport=not is_shown)
        if plane.parent is None:
            continue
        _place(plane, settings, fractions)
        plane.color[3] = settings.plane_opacity
        # At a detector, which is behind the ROI, it also faces whoever looks from the source.
        plane.empty_image_side = "DOUBLE_SIDED" if settings.plane_at_detector else "BACK"
        for background in _backgrounds(plane):
            background.show_background_image = settings.backgrounds
            background.alpha = settings.plane_opacity


def _place(plane: bpy.types.Object, settings: bpy.types.PropertyGroup, fractions: tuple[float, float]) -> None:
    """Place a plane on its camera, and the background where the camera sees it."""
    field = np.array(plane[_KEY])
    x, y, depth, width, height = field * relative_distance(settings, plane.parent.mphdrr_module, field[2])
    width, height = width * fractions[0], height * fractions[1]
    # A picture's longer side is as long as the empty; pixels that are not square are stretched.
    columns, rows = plane.data.size
    plane.empty_display_size = max(columns, rows)
    grabbing.set_home(plane, Matrix.LocRotScale((x, y, -depth), None, (width / columns, height / rows, 1.0)))
    _place_background(plane, fractions[0])


def _place_background(plane: bpy.types.Object, share: float) -> None:
    """Scale the picture over the camera's view to the size of the projection's field in that view."""
    camera, (x, y, depth, width, _) = plane.parent.data, plane[_KEY]
    seen_width = camera.sensor_width / camera.lens * depth  # of the camera's view at that depth
    scale = share * abs(width) / seen_width
    for background in _backgrounds(plane):
        if not math.isclose(background.scale, scale, rel_tol=_ROUNDING):  # writing updates the scene
            background.scale, background.offset = scale, (x / seen_width, y / seen_width)


def _backgrounds(plane: bpy.types.Object) -> list[bpy.types.CameraBackgroundImage]:
    """Return the backgrounds of the plane's camera that show its picture."""
    return [background for background in plane.parent.data.background_images if background.image == plane.data]


def relative_distance(settings: bpy.types.PropertyGroup, module: bpy.types.PropertyGroup, distance: float) -> float:
    """Return the distance of a module's plane from its pinhole, relative to the detector's `distance`, mm."""
    if settings.plane_at_detector:
        return 1.0
    return (settings.plane_distance or _DEFAULT_SHARE * (module.pinhole_distance - module.roi_radius)) / distance


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Make planes and backgrounds follow a change of the active module, of modules' visibility, or of `l`."""
    if depsgraph.id_type_updated("SCENE") and scene == bpy.context.scene:
        for plane, is_shown in _visibility(scene):
            objects.change(plane, hide_viewport=not is_shown)
    changed = {selection.module_of(u.id.original) for u in depsgraph.updates if u.id.id_type == "OBJECT"}
    changed.discard(None)
    if changed:
        share = images.shown_fraction()[0]
        for plane in planes(scene):
            if plane.parent in changed:
                _place_background(plane, share)


def _visibility(scene: bpy.types.Scene) -> list[tuple[bpy.types.Object, bool]]:
    """Return the planes of existing modules and the others, each with whether it is shown."""
    mode = scene.mphdrr_display.planes
    active = selection.active_module(bpy.context) if mode in ("ACTIVE", "RING") else None
    ring = None if active is None else active.mphdrr_module.ring

    def is_shown(camera: bpy.types.Object | None) -> bool:
        """Return whether the plane of a module's camera is to be seen."""
        if camera is None or camera.hide_viewport or mode == "NONE":
            return False
        return mode == "ALL" or camera == active or (mode == "RING" and camera.mphdrr_module.ring == ring)

    return [(plane, is_shown(plane.parent)) for plane in planes(scene) if plane.data is not None]


def _set_background(camera: bpy.types.Camera, field: NDArray[np.float64], picture: bpy.types.Image) -> None:
    """Lay a picture over a camera's view, flipped as the module's image `field` demands."""
    background = camera.background_images.new()
    background.image = picture
    background.frame_method, background.display_depth = "STRETCH", "FRONT"
    background.use_flip_x, background.use_flip_y = bool(field[3] < 0), bool(field[4] < 0)
    camera.show_background_images = True


def _remove_backgrounds(plane: bpy.types.Object) -> None:
    """Remove a plane's picture from its camera's view, if it has a camera."""
    for background in _backgrounds(plane) if plane.parent is not None else ():
        plane.parent.data.background_images.remove(background)
