"""Camera formats: ASTRA, LEAP, OpenCV, kornia, PyTorch3D, RTK, NeRF.

All but NeRF describe the arrays of images as they are. Pictures made by `mosaic.as_seen` are these turned by 180 degrees.
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

# Largest displacement of a pixel at the image's edge by a format, pixels; rounding views to float32 displaces less.
_TOLERANCE = 1e-3


def _array_format(name: str, title: str, arrays: Callable[..., dict[str, Any]]) -> Format:
    """Return the format that writes ``arrays(views, **options)``, arguments of a program's function, as .npz or JSON."""

    def write(system: Scanner, views: Views, temporary: Path, **options: Any) -> None:
        """Write the arrays into the file `temporary`."""
        values_by_name = arrays(views, **options)
        if temporary.name.lower().endswith(".json"):
            lists = {key: np.asarray(value).tolist() for key, value in values_by_name.items()}
            temporary.write_text(json.dumps(lists, indent=1) + "\n", encoding="utf-8")
            return
        buffer = io.BytesIO()  # NumPy would append .npz to a file name that ends in .NPZ
        np.savez(buffer, **values_by_name)
        temporary.write_bytes(buffer.getbuffer())

    return Format(name, title, (".npz", ".json"), write, options_source=arrays)


def _astra(views: Views, *, grid: Grid | None = None) -> dict[str, Any]:
    """Return the arguments of ASTRA's ``create_proj_geom("cone_vec")`` and, with `grid`, of ``create_vol_geom``.

    See https://astra-toolbox.com/docs/geom3d.html. ASTRA's volumes are [z, y, x] on an axis-aligned box: ``array.T`` of a
    Volume's array. The windows are the outer faces min_x, max_x, min_y, max_y, min_z, max_z, mm.
    """
    n_v, n_u = views.shape
    vectors = np.concatenate([views.sources, views.detector_centers, views.u_steps, views.v_steps], axis=1)
    arrays = {"det_row_count": n_v, "det_col_count": n_u, "vectors": vectors}
    if grid is None:
        return arrays
    instance(grid, Grid, "grid")
    if np.any(np.abs(grid.affine[:3, :3] - np.diag(grid.spacing)) > 1e-9 * grid.spacing.max()):
        raise InputError("format astra: expected a grid with axes along +x, +y, +z, got a turned one")
    corners = grid.corners()
    n_x, n_y, n_z = grid.shape
    windows = np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1).reshape(-1)
    return {**arrays, "volume_counts": np.array([n_y, n_x, n_z]), "volume_windows": windows}


def _leap(views: Views) -> dict[str, Any]:
    """Return the arguments of LEAP's ``set_modularbeam`` (https://leapct.readthedocs.io/en/latest/ctgeometries.html).

    ``rowVectors`` point to the next row, ``colVectors`` to the next column; all modules have the same pixel size.
    """
    views, (width, height), (columns, rows) = _with_common_pitch(views, "leap")
    sizes = {"numAngles": len(views), "numRows": views.shape[0], "numCols": views.shape[1]}
    pixel = {"pixelHeight": height, "pixelWidth": width}
    positions = {"sourcePositions": views.sources, "moduleCenters": views.detector_centers}
    vectors = {**positions, "rowVectors": rows, "colVectors": columns}
    return {**sizes, **pixel, **{name: vector.astype(np.float32) for name, vector in vectors.items()}}


def _opencv(views: Views) -> dict[str, Any]:
    """Return the matrices of OpenCV's ``projectPoints``: x right, y down, z forward; (0, 0) is the first pixel's centre."""
    matrices, rotations, translations = _camera_matrices(views, "opencv")
    return {"K": matrices, "R": rotations, "t": translations, "width": views.shape[1], "height": views.shape[0]}


def _kornia(views: Views) -> dict[str, Any]:
    """Return the arguments of ``kornia.geometry.camera.PinholeCamera``, which has OpenCV's axes and pixel coordinates."""
    matrices, rotations, translations = _camera_matrices(views, "kornia")
    intrinsics, extrinsics = affine_matrix(matrices, 0.0), affine_matrix(rotations, translations)
    height, width = np.tile(np.array(views.shape, np.float64), (len(views), 1)).T
    return {"intrinsics": intrinsics, "extrinsics": extrinsics, "height": height, "width": width}


def _pytorch3d(views: Views, *, in_ndc: bool = True) -> dict[str, Any]:
    """Return the arguments of PyTorch3D's ``PerspectiveCameras``: +X left, +Y up, +Z forward, ``X_view = X_world R + T``.

    See https://pytorch3d.org/docs/cameras. Screen space has its origin at the outer corner of pixel (0, 0), whose centre is
    (0.5, 0.5). NDC spans 2 over the shorter side, with its origin at the image's centre, x to the left and y up.
    """
    instance(in_ndc, bool, "in_ndc")
    matrices, rotations, translations = _camera_matrices(views, "pytorch3d")
    half_turn = np.array([-1.0, -1.0, 1.0])  # from x right, y down to x left, y up
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
    """Write RTK's ThreeDCircularProjectionGeometry, XML version 3 (https://docs.openrtk.org, "3D projection geometry").

    Each view has nine parameters, and the matrix from world mm to detector mm that follows from them.

    RTK's detector axes r and c are the directions of the arrays' columns and rows, so that no array need be flipped. Then
    r x c points along the rays, not against them, and RTK's distances, which may have either sign, are negative for images
    that are not mirrored. An RTK geometry does not contain the projections' spacing and origin: a comment does.
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
    """Return the gantry, out-of-plane and in-plane angles, rad, of R = Rz(-in) Rx(-out) Ry(-gantry).

    The in-plane angle is computed from the rotation that remains after the other two, so that R is exact also at
    out = 90 degrees, where gantry and in-plane angle turn about the same axis.
    """
    x, y, z = rotation[2]
    out_of_plane, gantry = -np.arctan2(y, np.hypot(x, z)), np.arctan2(x, z)
    (c, s), (c_out, s_out) = (np.cos(gantry), np.sin(gantry)), (np.cos(out_of_plane), np.sin(out_of_plane))
    about_y = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c_out, s_out], [0.0, -s_out, c_out]])
    in_plane = rotation @ (about_x @ about_y).T
    return float(gantry), float(out_of_plane), float(-np.arctan2(in_plane[1, 0], in_plane[0, 0]))


def _nerf(system: Scanner, views: Views, temporary: Path, *, pictures: str = "images/view_{}.png") -> None:
    """Write ``transforms.json`` of nerfstudio and instant-ngp.

    See https://docs.nerf.studio/quickstart/data_conventions.html. Cameras have +X right, +Y up and look along -Z, for
    pictures as the pinhole sees them (`mosaic.as_seen`).

    Values that all views share are at the top level, the others in the frames. cx and cy are relative to the outer corner of
    the top left pixel, whose centre is (0.5, 0.5).
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
    """Return the exact camera matrices K (M, 3, 3), rotations R (M, 3, 3) and translations t (M, 3), mm, of views.

    The image (column, row) of a world point X satisfies that ``K @ (R @ X + t)`` is a multiple of (column, row, 1); 0 is the
    centre of pixel 0. R is a proper rotation to x along the column index, y along the row index and z forward. The frames
    (u, v, k) of views are right-handed with k along the rays, so they are camera frames with the virtual detector and, as
    (-u, -v, k), with the real one. For a mirror image, which no rotation can express, the first focal length is negative;
    `InputError` for one unless `mirrored`.
    """
    pitches, (x, y) = _pixel_axes(views, format)
    z = np.cross(x, y)
    to_detector = views.detector_centers - views.sources
    distance = np.einsum("mi,mi->m", z, to_detector)
    is_mirrored = distance < 0
    if is_mirrored.any() and not mirrored:
        problem = f"format {format} cannot hold a mirror image"
        raise InputError(f"view {int(np.argmax(is_mirrored))}: {problem}; reverse its columns or its rows")
    sign = np.where(is_mirrored, -1.0, 1.0)
    n_v, n_u = views.shape
    foot_point = -np.stack([np.einsum("mi,mi->m", axis, to_detector) for axis in (x, y)], axis=1) / pitches
    matrices = np.tile(np.eye(3), (len(views), 1, 1))
    matrices[:, [0, 1], [0, 1]] = np.abs(distance)[:, None] / pitches
    matrices[:, 0, 0] *= sign
    matrices[:, :2, 2] = foot_point + (np.array([n_u, n_v]) - 1) / 2
    rotations = np.stack([sign[:, None] * x, y, sign[:, None] * z], axis=1)
    return matrices, rotations, -np.einsum("mij,mj->mi", rotations, views.sources)


def _pixel_axes(views: Views, format: str) -> tuple[Floats, Floats]:
    """Return the pixel pitches (M, 2), mm, and the unit vectors (2, M, 3) along the column and the row index.

    The second vectors are made exactly perpendicular to the first. `InputError` names the first view where they are not
    perpendicular within the tolerance.
    """
    pitches = np.stack([np.linalg.norm(views.u_steps, axis=1), np.linalg.norm(views.v_steps, axis=1)], axis=1)
    x, y = views.u_steps / pitches[:, :1], views.v_steps / pitches[:, 1:]
    cosine = np.einsum("mi,mi->m", x, y)
    n_v, n_u = views.shape
    proportion = pitches[:, 1] / pitches[:, 0]
    # Displacement, pixels, of the last row along the columns, and of the last column along the rows.
    slide = np.abs(cosine) * np.maximum(n_v * proportion, n_u / proportion) / 2
    for m in np.flatnonzero(~(slide <= _TOLERANCE))[:1]:
        angle = f"{np.degrees(np.arccos(cosine[m])):.4g} degrees apart"
        raise InputError(f"view {m}: format {format} needs pixel rows perpendicular to columns, and these are {angle}")
    y = y - cosine[:, None] * x
    return pitches, np.stack([x, y / np.linalg.norm(y, axis=1, keepdims=True)])


def _with_common_pitch(views: Views, format: str) -> tuple[Views, tuple[float, float], Floats]:
    """Return views of the same rays with one pixel pitch, that pitch (u, v), mm, and the unit vectors of `_pixel_axes`.

    Detectors with smaller pixels are moved away from their sources until their pixels are as large as the largest.
    `InputError` where the pixels of the views differ in their proportions.
    """
    pitches, axes = _pixel_axes(views, format)
    proportion = pitches[:, 1] / pitches[:, 0]
    stretch = np.abs(proportion / proportion[0] - 1) * max(views.shape) / 2
    for m in np.flatnonzero(~(stretch <= _TOLERANCE))[:1]:
        pixel, first_pixel = (f"{pitches[i, 0]:g} x {pitches[i, 1]:g} mm" for i in (m, 0))
        difference = f"its pixels of {pixel} have other proportions than view 0's of {first_pixel}"
        raise InputError(f"view {m}: format {format} has one pixel size for all views, and {difference}")
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
