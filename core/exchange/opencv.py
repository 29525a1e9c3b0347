"""OpenCV and kornia: intrinsics and extrinsics.

Camera axes are x right, y down, z forward; pixel (0, 0) is the centre of the first pixel (OpenCV, "Camera Calibration and
3D Reconstruction"; kornia.geometry.camera.PinholeCamera). The cameras describe the arrays as they are: x to the next
column, y to the next row. Pictures of `mosaic.as_seen` are turned by 180 degrees, and so must be their cameras.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.views import Views
from .camera_model import camera_model
from .format import array_format


def _opencv(views: Views) -> dict[str, Any]:
    camera = camera_model(views, "opencv")
    n_v, n_u = views.shape
    return {"K": camera.matrices, "R": camera.rotations, "t": camera.translations, "width": n_u, "height": n_v}


def _kornia(views: Views) -> dict[str, Any]:
    camera = camera_model(views, "kornia")
    intrinsics, extrinsics = np.tile(np.eye(4), (2, len(views), 1, 1))
    intrinsics[:, :3, :3] = camera.matrices
    extrinsics[:, :3, :3] = camera.rotations
    extrinsics[:, :3, 3] = camera.translations
    height, width = np.tile(np.array(views.shape, np.float64), (len(views), 1)).T
    return {"intrinsics": intrinsics, "extrinsics": extrinsics, "height": height, "width": width}


OPENCV = array_format("opencv", "OpenCV: camera matrices K, rotations R and translations t", _opencv)
KORNIA = array_format("kornia", "kornia: PinholeCamera's 4 x 4 intrinsics and extrinsics", _kornia)
