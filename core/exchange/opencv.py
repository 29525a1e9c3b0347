"""OpenCV and kornia: intrinsics and extrinsics.

Camera axes x right, y down, z forward, pixel (0, 0) the centre of pixel 0 (OpenCV, "Camera Calibration and 3D
Reconstruction"; kornia.geometry.camera.PinholeCamera). They describe the arrays as they are: x to the next column, y to
the next row. Of `mosaic.as_seen` pictures, which are turned by 180 degrees, they are the cameras turned likewise.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .arrays import SUFFIXES, write_arrays
from .cameras import cameras
from .format import Format


def _write_opencv(system: PinholeSystem, views: Views, path: Path) -> None:
    seen = cameras(views, "opencv")
    n_v, n_u = views.shape
    intrinsics = np.zeros((len(views), 3, 3))
    intrinsics[:, [0, 1], [0, 1]] = seen.focal_lengths
    intrinsics[:, :2, 2] = seen.principal_points
    intrinsics[:, 2, 2] = 1.0
    arrays = {"K": intrinsics, "R": seen.rotations, "t": seen.translations, "width": n_u, "height": n_v}
    write_arrays(path, arrays)


def _write_kornia(system: PinholeSystem, views: Views, path: Path) -> None:
    seen = cameras(views, "kornia")
    intrinsics = np.tile(np.eye(4), (len(views), 1, 1))
    intrinsics[:, [0, 1], [0, 1]] = seen.focal_lengths
    intrinsics[:, :2, 2] = seen.principal_points
    extrinsics = np.tile(np.eye(4), (len(views), 1, 1))
    extrinsics[:, :3, :3] = seen.rotations
    extrinsics[:, :3, 3] = seen.translations
    size = np.tile(np.array(views.shape, np.float64), (len(views), 1))
    arrays = {"intrinsics": intrinsics, "extrinsics": extrinsics, "height": size[:, 0], "width": size[:, 1]}
    write_arrays(path, arrays)


OPENCV = Format("opencv", "OpenCV: camera matrices K, rotations R and translations t", SUFFIXES, _write_opencv)
KORNIA = Format("kornia", "kornia: PinholeCamera's 4 x 4 intrinsics and extrinsics", SUFFIXES, _write_kornia)
