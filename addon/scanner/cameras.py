"""Camera datablocks that see exactly the view of their module.

A Blender camera is right-handed with X right, Y up and looks along -Z; seen from the pinhole, +v is up and +u is
to the LEFT. So a module's camera has X = -u, Y = v, Z = -k.
"""

from ast import literal_eval
from functools import lru_cache
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

_KEY = "mphdrr_solid"  # custom property of a camera: the field that it was set to, as a text
_CAMERA_FROM_MODULE = np.diag([-1.0, 1.0, -1.0, 1.0])
_ROUNDING = 1e-5  # rounding of a field of view, relative to its width
_MIN_SIZE = 1.0  # Blender silently clamps Camera.lens and Camera.sensor_width below this

Field = tuple[float, ...]
"""x, y and distance of the centre of a camera's field, then width and height, in any unit: only their ratios matter."""


def camera_matrices(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the world matrices (M, 4, 4) of the cameras of modules at `poses` (M, 4, 4)."""
    return poses @ _CAMERA_FROM_MODULE


def module_poses(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (M, 4, 4) of modules from their cameras' world matrices (M, 4, 4), whose scale is removed.

    A module that is mirrored, as by its parent's scale, is itself again with +u to the other side.
    """
    poses = matrices @ _CAMERA_FROM_MODULE
    poses[:, :3, :3] /= np.linalg.norm(poses[:, :3, :3], axis=1, keepdims=True)
    poses[:, :3, 0] *= np.sign(np.linalg.det(poses[:, :3, :3]))[:, None]
    return poses


def set_field_of_view(camera: bpy.types.Camera, field: Field) -> None:
    """Make a camera see exactly a field."""
    x, y, distance, width, height = field
    width, height = abs(width), abs(height)  # an image may be upside down
    scale = max(1.0, *(_MIN_SIZE / size for size in (width, height, distance)))
    camera.type = "PERSP"
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width, camera.sensor_height = width * scale, height * scale
    camera.lens_unit = "MILLIMETERS"
    camera.lens = distance * scale
    camera.shift_x, camera.shift_y = x / width, y / width
    camera[_KEY] = _format_field(field)


def has_field_of_view(camera: bpy.types.Camera) -> bool:
    """Return whether the user has left a camera's lens and sensor as `set_field_of_view` set them."""
    if _KEY not in camera:
        return True
    x, y, distance, width, _ = field_of(camera)
    errors = camera.sensor_width / camera.lens * distance / abs(width) - 1.0, camera.shift_x, camera.shift_y
    return (
        camera.type == "PERSP"
        and camera.sensor_fit == "HORIZONTAL"
        and all(abs(a - b) < _ROUNDING for a, b in zip(errors, (0.0, x / abs(width), y / abs(width)), strict=True))
    )


def is_set_to(camera: bpy.types.Camera, field: Field) -> bool:
    """Return whether a camera was last set to a field."""
    return bool(camera.get(_KEY) == _format_field(field))


def field_of(camera: bpy.types.Camera) -> Field:
    """Return the field that a camera was last set to."""
    return _parse_field(camera[_KEY])


def _format_field(field: Field) -> str:
    """Return a field as the text that cameras keep.

    A square field around the axis is (distance, side), as in the first versions.
    """
    x, y, distance, width, height = field
    return repr((distance, width) if x == y == 0 and width == height else tuple(field))


@lru_cache(maxsize=4096)
def _parse_field(text: str) -> Field:
    """Return the field of a text from `_format_field`."""
    numbers: Any = literal_eval(text)
    return numbers if len(numbers) > 2 else (0.0, 0.0, *numbers, numbers[1])


def copy_backgrounds(new: Any, old: Any) -> None:
    """Copy the background pictures of a camera, with their settings, to another camera."""
    new.show_background_images = old.show_background_images
    for picture in old.background_images:
        _copy_settings(new.background_images.new(), picture)


def _copy_settings(new: Any, old: Any) -> None:
    """Copy the settings of a background picture."""
    for setting in old.bl_rna.properties:
        name = setting.identifier
        if not setting.is_readonly:
            setattr(new, name, getattr(old, name))
        elif name in ("image_user", "clip_user"):  # the frames to show
            _copy_settings(getattr(new, name), getattr(old, name))


def set_up_camera(camera: bpy.types.Camera, field: Field, distance: float) -> None:
    """Set up the camera data of a module that sees `field` from `distance` to the isocentre, mm."""
    set_field_of_view(camera, field)
    camera.clip_start = min(1.0, 0.01 * distance)
    camera.clip_end = 40.0 * distance
    camera.display_size = 0.025 * distance  # small: those of all modules would hide what they see
    camera.passepartout_alpha = 0.9
