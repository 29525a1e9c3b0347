"""RTK: ThreeDCircularProjectionGeometry, XML version 3 (https://docs.openrtk.org, "3D projection geometry")."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .cameras import pixel_axes, with_common_pitch
from .format import Format

_PARAMETERS = (
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "SourceOffsetX",
    "SourceOffsetY",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
    "GantryAngle",
    "OutOfPlaneAngle",
    "InPlaneAngle",
)


def _euler_angles(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
    """Gantry, out-of-plane and in-plane angle, radians, of R = Rz(-in) Rx(-out) Ry(-gantry).

    The last is what the first two leave over, so that nothing is lost where they make the other two one (out = 90
    degrees).
    """
    normal = rotation[2]
    out = -np.arctan2(normal[1], np.hypot(normal[0], normal[2]))
    gantry = -np.arctan2(-normal[0], normal[2])
    rest = rotation @ (_about_x(-out) @ _about_y(-gantry)).T
    return float(gantry), float(out), float(-np.arctan2(rest[1, 0], rest[0, 0]))


def _about_x(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_y(angle: float) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _write(system: PinholeSystem, views: Views, path: Path) -> None:
    """Nine parameters a view, and the matrix from world mm to detector mm that follows from them.

    RTK's detector axes are r, c and r x c. They are the arrays' columns and rows here, so that no array need be turned
    over; r x c then points along the rays, not against them, and RTK's distances, which may have either sign, come out
    negative for images that are not mirrored. Detector mm are pixels times the pitch from the image's middle: the
    projections' spacing and origin, which are no part of an RTK geometry, stand in a comment.
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
        angles = np.degrees(_euler_angles(rotation))
        values = (source[2], distance, source[0], source[1], detector[0], detector[1], *angles)
        # p = T(source - detector) diag(-SDD, -SDD, 1) [x - source]
        shift = np.array([[1.0, 0.0, source[0] - detector[0]], [0.0, 1.0, source[1] - detector[1]], [0.0, 0.0, 1.0]])
        linear = shift @ np.diag([-distance, -distance, 1.0]) @ rotation
        matrix = np.column_stack([linear, -linear @ views.sources[m]])
        lines.append("  <Projection>")
        lines += [f"    <{name}>{float(value)!r}</{name}>" for name, value in zip(_PARAMETERS, values, strict=True)]
        lines.append("    <Matrix>")
        lines += ["      " + " ".join(repr(float(x)) for x in row) for row in matrix]
        lines += ["    </Matrix>", "  </Projection>"]
    lines.append("</RTKThreeDCircularGeometry>")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


RTK = Format("rtk", "RTK: ThreeDCircularProjectionGeometry", (".xml",), _write)
