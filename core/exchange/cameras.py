"""Formats of cameras: ASTRA, LEAP, OpenCV, kornia, PyTorch3D, RTK, NeRF.

All but NeRF's describe the images' arrays as they are; pictures of `mosaic.as_seen` are turned by 180 degrees.
"""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..geometry.frames import affine_matrix
from ..geometry.grid import Grid
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..validation import instance
from .format import Format

# How far a format may move a pixel at the image's edge, in pixels. Views rounded to float32 stay within it.
_TOLERANCE = 1e-3


def _array_format(name: str, title: str, arrays: Callable[..., dict[str, Any]]) -> Format:
    """A format of ``arrays(views, **options)``, the arguments of the program's own function: NumPy's .npz, or JSON."""

    def write(system: Scanner, views: Views, temporary: Path, **options: Any) -> None:
        named = arrays(views, **options)
        if temporary.name.lower().endswith(".json"):
            lists = {key: np.asarray(value).tolist() for key, value in named.items()}
            temporary.write_text(json.dumps(lists, indent=1) + "\n", encoding="utf-8")
            return
        memory = io.BytesIO()  # given a name, NumPy would add .npz to .NPZ
        np.savez(memory, **named)
        temporary.write_bytes(memory.getbuffer())

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
    views, (width, height), (columns, rows) = _with_common_pitch(views, "leap")
    sizes = {"numAngles": len(views), "numRows": views.shape[0], "numCols": views.shape[1]}
    pixel = {"pixelHeight": height, "pixelWidth": width}
    places = {"sourcePositions": views.sources, "moduleCenters": views.detector_centers}
    vectors = {**places, "rowVectors": rows, "colVectors": columns}
    return {**sizes, **pixel, **{name: vector.astype(np.float32) for name, vector in vectors.items()}}


def _opencv(views: Views) -> dict[str, Any]:
    """``projectPoints``: x right, y down, z forward; pixel (0, 0) is the centre of the first pixel."""
    matrices, rotations, translations = _camera_matrices(views, "opencv")
    return {"K": matrices, "R": rotations, "t": translations, "width": views.shape[1], "height": views.shape[0]}


def _kornia(views: Views) -> dict[str, Any]:
    """``kornia.geometry.camera.PinholeCamera``, whose axes and pixels are OpenCV's."""
    matrices, rotations, translations = _camera_matrices(views, "kornia")
    intrinsics, extrinsics = affine_matrix(matrices, 0.0), affine_matrix(rotations, translations)
    height, width = np.tile(np.array(views.shape, np.float64), (len(views), 1)).T
    return {"intrinsics": intrinsics, "extrinsics": extrinsics, "height": height, "width": width}


def _pytorch3d(views: Views, *, in_ndc: bool = True) -> dict[str, Any]:
    """``PerspectiveCameras`` (https://pytorch3d.org/docs/cameras): +X left, +Y up, +Z forward, ``X_view = X_world R + T``.

    Screen space has its origin at the outer corner of pixel (0, 0), whose centre is (0.5, 0.5). NDC spans 2 over the
    shorter side, with its origin in the middle of the image, x to the left and y up.
    """
    instance(in_ndc, bool, "in_ndc")
    matrices, rotations, translations = _camera_matrices(views, "pytorch3d")
    half_turn = np.array([-1.0, -1.0, 1.0])  # x right, y down to x left, y up
    focal, principal = matrices[:, [0, 1], [0, 1]], matrices[:, :2, 2] + 0.5
    if in_ndc:
        half_side = min(views.shape) / 2
        focal = focal / half_side
        principal = (np.array(views.shape[::-1]) / 2 - principal) / half_side
    poses = {"R": rotations.transpose(0, 2, 1) * half_turn, "T": translations * half_turn}
    size = np.tile(views.shape, (len(views), 1))
    return {**poses, "focal_length": focal, "principal_point": principal, "image_size": size, "in_ndc": in_ndc}


_RTK_PARAMETERS = (
    *("SourceToIsocenterDistance", "SourceToDetectorDistance", "SourceOffsetX", "SourceOffsetY"),
    *("ProjectionOffsetX", "ProjectionOffsetY", "GantryAngle", "OutOfPlaneAngle", "InPlaneAngle"),
)


def _rtk(system: Scanner, views: Views, temporary: Path) -> None:
    """ThreeDCircularProjectionGeometry, XML version 3 (https://docs.openrtk.org, "3D projection geometry").

    Nine parameters a view, and the matrix from world mm to detector mm that follows from them.

    RTK's detector axes r and c are the arrays' columns and rows, so that no array need be flipped. Then r x c points along
    the rays, not against them, and RTK's distances, which may have either sign, are negative for images that are not
    mirrored. The projections' spacing and origin are not part of an RTK geometry: they stand in a comment.
    """
    views, pitch, (r, c) = _with_common_pitch(views, "rtk")
    n_v, n_u = views.shape
    origin = [-(n_u - 1) / 2 * pitch[0], -(n_v - 1) / 2 * pitch[1]]
    lines = [
        '<?xml version="1.0"?>',
        "<!DOCTYPE RTKGEOMETRY>",
        f"<!-- projections: size {n_u} {n_v} {len(views)}, spacing {pitch[0]!r} {pitch[1]!r} 1, "
        f"origin {origin[0]!r} {origin[1]!r} 0 -->",
        '<RTKThreeDCircularGeometry version="3">',
    ]
    for m in range(len(views)):
        rotation = np.stack([r[m], c[m], np.cross(r[m], c[m])])
        source, detector = rotation @ views.sources[m], rotation @ views.detector_centers[m]
        distance = source[2] - detector[2]
        values = (source[2], distance, *source[:2], *detector[:2], *np.degrees(_euler_angles(rotation)))
        # p = T(source - detector) diag(-SDD, -SDD, 1) [x - source]
        shift = np.eye(3)
        shift[:2, 2] = source[:2] - detector[:2]
        linear = shift @ np.diag([-distance, -distance, 1.0]) @ rotation
        matrix = np.column_stack([linear, -linear @ views.sources[m]])
        lines.append("  <Projection>")
        lines += [f"    <{name}>{float(value)!r}</{name}>" for name, value in zip(_RTK_PARAMETERS, values, strict=True)]
        lines.append("    <Matrix>")
        lines += ["      " + " ".join(repr(float(x)) for x in row) for row in matrix]
        lines += ["    </Matrix>", "  </Projection>"]
    lines.append("</RTKThreeDCircularGeometry>")
    temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def _euler_angles(rotation: Floats) -> tuple[float, float, float]:
    """Gantry, out-of-plane and in-plane angle, rad, of R = Rz(-in) Rx(-out) Ry(-gantry).

    The in-plane angle is what remains after the other two, so R is exact at out = 90 degrees too, where gantry and in-plane
    angle turn about the same axis.
    """
    x, y, z = rotation[2]
    out, gantry = -np.arctan2(y, np.hypot(x, z)), np.arctan2(x, z)
    (c, s), (c_out, s_out) = (np.cos(gantry), np.sin(gantry)), (np.cos(out), np.sin(out))
    about_y = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c_out, s_out], [0.0, -s_out, c_out]])
    rest = rotation @ (about_x @ about_y).T
    return float(gantry), float(out), float(-np.arctan2(rest[1, 0], rest[0, 0]))


def _nerf(system: Scanner, views: Views, temporary: Path, *, pictures: str = "images/view_{}.png") -> None:
    """``transforms.json`` of nerfstudio (https://docs.nerf.studio/quickstart/data_conventions.html) and instant-ngp.

    Cameras +X right, +Y up, looking along -Z, of pictures as the pinhole sees them (`mosaic.as_seen`).

    Numbers that all views share stand at the top, the others in the frames. cx and cy count from the outer corner of the
    top left pixel, whose centre is (0.5, 0.5).
    """
    if not isinstance(pictures, str) or "{}" not in pictures:
        raise InputError(f"pictures {pictures!r}: expected a file name with {{}} for the view's number")
    matrices, rotations, _ = _camera_matrices(views, "nerf", mirrored=False)
    n_v, n_u = views.shape
    # The picture is the array turned by 180 degrees, and so is the camera; then x right, y down becomes x right, y up.
    axes = rotations * np.array([-1.0, 1.0, -1.0])[:, None]
    poses = affine_matrix(axes.transpose(0, 2, 1), views.sources)
    (fl_x, _, cx), (_, fl_y, cy), _ = matrices.transpose(1, 2, 0)
    cx, cy = n_u - 0.5 - cx, n_v - 0.5 - cy
    intrinsics = {"camera_angle_x": 2 * np.arctan(n_u / 2 / fl_x), "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
    common = {name: float(values[0]) for name, values in intrinsics.items() if np.ptp(values) < 1e-9}
    numbers = system.numbers if len(system) == len(views) else np.arange(1, len(views) + 1)
    digits = len(str(numbers.max()))
    frames = [
        {
            "file_path": pictures.replace("{}", f"{number:0{digits}d}"),
            **{name: float(values[m]) for name, values in intrinsics.items() if name not in common},
            "transform_matrix": poses[m].tolist(),
        }
        for m, number in enumerate(numbers)
    ]
    document = {"camera_model": "PINHOLE", "w": n_u, "h": n_v, **common, "frames": frames}
    temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _camera_matrices(views: Views, format: str, mirrored: bool = True) -> tuple[Floats, ...]:
    """Camera matrices K (M, 3, 3), rotations R (M, 3, 3) and translations t (M, 3), mm, of `views`, exactly.

    World point X is seen where ``K @ (R @ X + t)`` is a multiple of (column, row, 1); 0 is the centre of pixel 0. R is a
    proper rotation to x along the columns' index, y along the rows' and z forward: the frames (u, v, k) of views are
    right-handed with k along the rays, so they are cameras as they stand, with the virtual detector and, as (-u, -v, k),
    with the real one. The first focal length is negative for a mirror image, which no rotation can express, and
    refused unless `mirrored`.
    """
    pitches, (x, y) = _pixel_axes(views, format)
    z = np.cross(x, y)
    to_detector = views.detector_centers - views.sources
    distance = np.einsum("mi,mi->m", z, to_detector)
    mirror = distance < 0
    if mirror.any() and not mirrored:
        cannot = f"format {format} cannot hold a mirror image"
        raise InputError(f"view {int(np.argmax(mirror))}: {cannot}; reverse its columns or its rows")
    sign = np.where(mirror, -1.0, 1.0)
    n_v, n_u = views.shape
    foot = -np.stack([np.einsum("mi,mi->m", axis, to_detector) for axis in (x, y)], axis=1) / pitches
    matrices = np.tile(np.eye(3), (len(views), 1, 1))
    matrices[:, [0, 1], [0, 1]] = np.abs(distance)[:, None] / pitches
    matrices[:, 0, 0] *= sign
    matrices[:, :2, 2] = foot + (np.array([n_u, n_v]) - 1) / 2
    rotations = np.stack([sign[:, None] * x, y, sign[:, None] * z], axis=1)
    return matrices, rotations, -np.einsum("mij,mj->mi", rotations, views.sources)


def _pixel_axes(views: Views, format: str) -> tuple[Floats, Floats]:
    """Pixel pitches (M, 2), mm, and unit vectors (2, M, 3) along columns' and rows' index.

    The second vectors are made exactly perpendicular to the first; the message names the first view where they are not.
    """
    pitches = np.stack([np.linalg.norm(views.u_steps, axis=1), np.linalg.norm(views.v_steps, axis=1)], axis=1)
    x, y = views.u_steps / pitches[:, :1], views.v_steps / pitches[:, 1:]
    cosine = np.einsum("mi,mi->m", x, y)
    n_v, n_u = views.shape
    proportion = pitches[:, 1] / pitches[:, 0]
    # How far the last row slides along the columns, and the last column along the rows, in pixels.
    slide = np.abs(cosine) * np.maximum(n_v * proportion, n_u / proportion) / 2
    for m in np.flatnonzero(~(slide <= _TOLERANCE))[:1]:
        found = f"{np.degrees(np.arccos(cosine[m])):.4g} degrees apart"
        raise InputError(f"view {m}: format {format} needs pixel rows perpendicular to columns, and these are {found}")
    y = y - cosine[:, None] * x
    return pitches, np.stack([x, y / np.linalg.norm(y, axis=1, keepdims=True)])


def _with_common_pitch(views: Views, format: str) -> tuple[Views, tuple[float, float], Floats]:
    """The same rays with one pixel size (pitch_u, pitch_v), mm, for all detectors; that size; and the `_pixel_axes`.

    Detectors with smaller pixels are moved away from their sources until their pixels are as large as the largest.
    Views whose pixels have different proportions are refused.
    """
    pitches, axes = _pixel_axes(views, format)
    proportion = pitches[:, 1] / pitches[:, 0]
    stretch = np.abs(proportion / proportion[0] - 1) * max(views.shape) / 2
    for m in np.flatnonzero(~(stretch <= _TOLERANCE))[:1]:
        its, first = (f"{pitches[i, 0]:g} x {pitches[i, 1]:g} mm" for i in (m, 0))
        differ = f"its pixels of {its} have other proportions than view 0's of {first}"
        raise InputError(f"view {m}: format {format} has one pixel size for all views, and {differ}")
    pitch_u, pitch_v = pitches[np.argmax(pitches[:, 0])].tolist()
    scale = pitch_u / pitches[:, :1]
    centers = views.sources + scale * (views.detector_centers - views.sources)
    scaled = Views(views.sources, centers, scale * views.u_steps, scale * views.v_steps, views.shape)
    return scaled, (pitch_u, pitch_v), axes


ASTRA = _array_format("astra", "ASTRA Toolbox: cone_vec vectors", _astra)
LEAP = _array_format("leap", "LEAP: modular-beam geometry", _leap)
OPENCV = _array_format("opencv", "OpenCV: camera matrices K, rotations R and translations t", _opencv)
KORNIA = _array_format("kornia", "kornia: PinholeCamera's 4 x 4 intrinsics and extrinsics", _kornia)
PYTORCH3D = _array_format("pytorch3d", "PyTorch3D: PerspectiveCameras in NDC, or in screen space", _pytorch3d)
RTK = Format("rtk", "RTK: ThreeDCircularProjectionGeometry", (".xml",), _rtk)
NERF = Format("nerf", "NeRF: transforms.json of nerfstudio and instant-ngp", (".json",), _nerf)
