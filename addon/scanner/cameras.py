"""Camera datablocks that see what a module's virtual detector sees.

A Blender camera is right-handed with X right, Y up and looks along -Z; seen from the pinhole, +v is up and +u is
to the LEFT. So a module's camera has X = -u, Y = v, Z = -k.
"""

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.geometry.frames import module_poses
from ...core.geometry.system import PinholeSystem

_CAMERA_FROM_MODULE = np.diag([-1.0, 1.0, -1.0, 1.0])
_ROUNDING = 1e-5  # of a field of view
_SMALLEST = 1.0  # Blender silently clamps Camera.lens and Camera.sensor_width below this


def camera_matrices(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """World matrices (M, 4, 4) of cameras at pinhole `centers` (M, 3), mm, aimed at the isocentre."""
    return module_poses(centers) @ _CAMERA_FROM_MODULE


def set_field_of_view(camera: bpy.types.Camera, width: float, distance: float) -> None:
    """Make the picture `width` wide at `distance` from the pinhole (any unit: only their ratio counts)."""
    scale = max(1.0, _SMALLEST / width, _SMALLEST / distance)
    camera.type = "PERSP"
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = width * scale
    camera.lens_unit = "MILLIMETERS"
    camera.lens = distance * scale
    camera.shift_x = camera.shift_y = 0.0


def has_field_of_view(camera: bpy.types.Camera, width: float, distance: float) -> bool:
    """Whether the picture is as `set_field_of_view` makes it."""
    straight = camera.type == "PERSP" and camera.sensor_fit == "HORIZONTAL" and camera.shift_x == camera.shift_y == 0.0
    return straight and abs(camera.sensor_width / camera.lens * distance / width - 1.0) < _ROUNDING


def set_up_camera(camera: bpy.types.Camera, system: PinholeSystem, m: int) -> None:
    """Set up camera data for module `m`, with the field of view of the default virtual detector."""
    set_field_of_view(camera, float(system.detector_side[m]), float(system.collimator_length[m]))
    b, radius = float(system.pinhole_distance[m]), float(system.roi_radius[m])
    camera.clip_start = min(1.0, 0.01 * b)
    camera.clip_end = 20.0 * (b + radius)
    camera.display_size = 0.3 * float(system.detector_side[m])
    camera.passepartout_alpha = 0.9
