"""RTK: ThreeDCircularProjectionGeometry, XML version 3 (https://docs.openrtk.org, "3D projection geometry")."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .camera_model import pixel_axes, with_common_pitch
from .format import Format

_PARAMETERS = (
    *("SourceToIsocenterDistance", "SourceToDetectorDistance", "SourceOffsetX", "SourceOffsetY"),
    *("ProjectionOffsetX", "ProjectionOffsetY", "GantryAngle", "OutOfPlaneAngle", "InPlaneAngle"),
)


def _write(system: PinholeSystem, views: Views, path: Path) -> None:
    """Nine parameters a view, and the matrix from world mm to detector mm that follows from them.

    RTK's detector axes r and c are the arrays' columns and rows, so that no array need be flipped. Then r x c points along
    the rays, not against them, and RTK's distances, which may have either sign, are negative for images that are not
    mirrored. The projections' spacing and origin are not part of an RTK geometry: they stand in a comment.
    """
    views, pitch = with_common_pitch(views, "rtk")
    _, (r, c) = pixel_axes(views)
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
        lines += [f"    <{name}>{float(value)!r}</{name}>" for name, value in zip(_PARAMETERS, values, strict=True)]
        lines.append("    <Matrix>")
        lines += ["      " + " ".join(repr(float(x)) for x in row) for row in matrix]
        lines += ["    </Matrix>", "  </Projection>"]
    lines.append("</RTKThreeDCircularGeometry>")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _euler_angles(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
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


RTK = Format("rtk", "RTK: ThreeDCircularProjectionGeometry", (".xml",), _write)
