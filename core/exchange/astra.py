"""ASTRA Toolbox: ``cone_vec`` geometry (https://astra-toolbox.com/docs/geom3d.html)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..validation import instance
from .format import array_format


def _arrays(views: Views, *, grid: Grid | None = None) -> dict[str, Any]:
    """The arguments of ``create_proj_geom`` and, with `grid`, of ``create_vol_geom``.

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


ASTRA = array_format("astra", "ASTRA Toolbox: cone_vec vectors", _arrays)
