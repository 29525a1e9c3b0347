"""PyTomography: the arguments of ``CTConeBeamFlatPanelProjMeta``, where they can say what the views are.

PyTomography 3.4 has no pinholes: its SPECT metadata are parallel holes. Its cone-beam CT metadata hold sources and flat
panels opposite each other on two circles about the z axis, and that is all that is written here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .arrays import SUFFIXES, write_arrays
from .cameras import first_off, pixel_axes, with_common_pitch
from .format import Format


def _write(system: PinholeSystem, views: Views, path: Path) -> None:
    """Its projections are (M, columns, rows): ``images.transpose(0, 2, 1)``, with those axes flipped that the file names."""
    views, pitch = with_common_pitch(views, "pytomography")
    _, (columns, rows) = pixel_axes(views)
    n_v, n_u = views.shape
    angles = np.arctan2(-views.sources[:, 1], -views.sources[:, 0])
    out = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    beam = float(np.linalg.norm(views.sources[0, :2]))
    detector = float(views.detector_centers[0] @ out[0])
    z = views.sources[:, 2]
    # Its panels face the origin, so that those away from z = 0 are tilted: r and p as in its source.
    centers = detector * out + z[:, None] * [0.0, 0.0, 1.0]
    with np.errstate(invalid="ignore"):  # what is no number is refused below
        facing = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    r = np.stack([facing[:, 1], -facing[:, 0], np.zeros_like(z)], axis=1)
    p = np.cross(facing, r)
    flips = np.sign([columns[0] @ r[0], rows[0] @ p[0]])
    dr = pitch / np.array([np.linalg.norm(r[0]), np.linalg.norm(p[0])])
    half = np.array([n_u, n_v]) / 2
    errors = (
        views.sources - (z[:, None] * [0.0, 0.0, 1.0] - beam * out),
        views.detector_centers - centers,
        (views.u_steps - flips[0] * dr[0] * r) * half[0],
        (views.v_steps - flips[1] * dr[1] * p) * half[1],
    )
    off = np.sum([np.linalg.norm(error, axis=1) for error in errors], axis=0) / min(pitch)
    m = first_off(off) if detector > 0 else 0
    if m is not None:
        raise InputError(
            f"view {m}: format pytomography holds sources on one circle about the z axis whose principal rays are "
            f"horizontal, cross the axis and meet panels of one distance and pixel size in their middles"
        )
    arrays = {
        "angles": angles,
        "z_locations": z,
        "detector_radius": detector,
        "beam_radius": beam,
        "shape": [n_u, n_v],
        "dr": dr,
        "flip_columns": bool(flips[0] < 0),
        "flip_rows": bool(flips[1] < 0),
    }
    write_arrays(path, arrays)


PYTOMOGRAPHY = Format("pytomography", "PyTomography: cone-beam metadata, for one horizontal ring", SUFFIXES, _write)
