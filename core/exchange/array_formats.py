"""Formats of named arrays, as NumPy's .npz or JSON: ASTRA, LEAP, OpenCV, kornia, PyTorch3D.

Each is a function from views to the arguments of the program's own function, by their names there. They describe the images'
arrays as they are; pictures of `mosaic.as_seen` are turned by 180 degrees.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..validation import instance
from .camera_model import camera_model, pixel_axes, with_common_pitch
from .format import Format


def _array_format(name: str, title: str, arrays: Callable[..., dict[str, Any]]) -> Format:
    """A format of ``arrays(views, **options)``."""

    def write(system: PinholeSystem, views: Views, path: Path, **options: Any) -> None:
        named = arrays(views, **options)
        if path.name.lower().endswith(".json"):
            lists = {key: np.asarray(value).tolist() for key, value in named.items()}
            path.write_text(json.dumps(lists, indent=1) + "\n", encoding="utf-8")
            return
        with open(path, "wb") as file:  # given a name, NumPy would add .npz to .NPZ
            np.savez(file, **named)

    return Format(name, title, (".npz", ".json"), write, options_of=arrays)


def _astra(views: Views, *, grid: Grid | None = None) -> dict[str, Any]:
    """``create_proj_geom("cone_vec")`` and, with `grid`, ``create_vol_geom`` (https://astra-toolbox.com/docs/geom3d.html).

    ASTRA's volumes are [z, y, x] on an axis-aligned box: ``array.T`` of a Volume's array. The windows are the outer faces
    min_x, max_x, min_y, max_y, min_z, max_z, mm.
    """
    n_v, n_u = views.shape
    vectors = np.concatenate([views.sources, views.detector_centers, views.u_steps, views.v_steps], axis=1)
    arrays = {"det_row_count": n_v, "det_col_count": n_u, "vectors": vectors}
    if grid is None:
        return arrays
    instance(grid, Grid, "grid")
    if np.any(np.abs(grid.affine[:3, :3] - np.diag(grid.spacing)) > 1e-9 * grid.spacing.max()):
        raise InputError("format astra: its volumes lie along +x, +y, +z, and this grid's axes do not")
    corners = grid.corners()
    n_x, n_y, n_z = grid.shape
    windows = np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1).reshape(-1)
    return {**arrays, "volume_counts": np.array([n_y, n_x, n_z]), "volume_windows": windows}


def _leap(views: Views) -> dict[str, Any]:
    """``set_modularbeam`` (https://leapct.readthedocs.io/en/latest/ctgeometries.html).

    ``rowVectors`` point to the next row, ``colVectors`` to the next column; all modules have one pixel size.
    """
    views, (width, height) = with_common_pitch(views, "leap")
    _, (columns, rows) = pixel_axes(views)
    vectors = {
        "sourcePositions": views.sources,
        "moduleCenters": views.detector_centers,
        "rowVectors": rows,
        "colVectors": columns,
    }
    return {
        "numAngles": len(views),
        "numRows": views.shape[0],
        "numCols": views.shape[1],
        "pixelHeight": height,
        "pixelWidth": width,
        **{name: vector.astype(np.float32) for name, vector in vectors.items()},
    }


def _opencv(views: Views) -> dict[str, Any]:
    """``projectPoints``: x right, y down, z forward; pixel (0, 0) is the centre of the first pixel."""
    camera = camera_model(views, "opencv")
    n_v, n_u = views.shape
    return {"K": camera.matrices, "R": camera.rotations, "t": camera.translations, "width": n_u, "height": n_v}


def _kornia(views: Views) -> dict[str, Any]:
    """``kornia.geometry.camera.PinholeCamera``, whose axes and pixels are OpenCV's."""
    camera = camera_model(views, "kornia")
    intrinsics, extrinsics = np.tile(np.eye(4), (2, len(views), 1, 1))
    intrinsics[:, :3, :3] = camera.matrices
    extrinsics[:, :3, :3] = camera.rotations
    extrinsics[:, :3, 3] = camera.translations
    height, width = np.tile(np.array(views.shape, np.float64), (len(views), 1)).T
    return {"intrinsics": intrinsics, "extrinsics": extrinsics, "height": height, "width": width}


def _pytorch3d(views: Views, *, in_ndc: bool = True) -> dict[str, Any]:
    """``PerspectiveCameras`` (https://pytorch3d.org/docs/cameras): +X left, +Y up, +Z forward, ``X_view = X_world R + T``.

    Screen space has its origin at the outer corner of pixel (0, 0), whose centre is (0.5, 0.5). NDC spans 2 over the
    shorter side, with its origin in the middle of the image, x to the left and y up.
    """
    instance(in_ndc, bool, "in_ndc")
    camera = camera_model(views, "pytorch3d")
    half_turn = np.array([-1.0, -1.0, 1.0])  # x right, y down to x left, y up
    focal, principal = camera.focal_lengths, camera.principal_points + 0.5
    if in_ndc:
        half_side = min(views.shape) / 2
        focal = focal / half_side
        principal = (np.array(views.shape[::-1]) / 2 - principal) / half_side
    return {
        "R": camera.rotations.transpose(0, 2, 1) * half_turn,
        "T": camera.translations * half_turn,
        "focal_length": focal,
        "principal_point": principal,
        "image_size": np.tile(views.shape, (len(views), 1)),
        "in_ndc": in_ndc,
    }


ASTRA = _array_format("astra", "ASTRA Toolbox: cone_vec vectors", _astra)
LEAP = _array_format("leap", "LEAP: modular-beam geometry", _leap)
OPENCV = _array_format("opencv", "OpenCV: camera matrices K, rotations R and translations t", _opencv)
KORNIA = _array_format("kornia", "kornia: PinholeCamera's 4 x 4 intrinsics and extrinsics", _kornia)
PYTORCH3D = _array_format("pytorch3d", "PyTorch3D: PerspectiveCameras in NDC, or in screen space", _pytorch3d)
