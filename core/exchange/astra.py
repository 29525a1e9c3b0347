"""ASTRA Toolbox: ``cone_vec`` (https://astra-toolbox.com/docs/geom3d.html)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..validation import instance
from .arrays import SUFFIXES, write_arrays
from .format import Format


def cone_vectors(views: Views) -> NDArray[np.float64]:
    """ASTRA's (M, 12): source, detector centre, step from column 0 to 1, step from row 0 to 1, in mm."""
    return np.concatenate([views.sources, views.detector_centers, views.u_steps, views.v_steps], axis=1)


def volume_geometry(grid: Grid) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The arguments of ``astra.create_vol_geom``: (rows, columns, slices) and the windows, in mm.

    ASTRA's arrays are [z, y, x] on an axis-aligned box: those of a Volume with its axes reversed, ``array.T``.

    Returns
    -------
    counts : int array (3,)
        Voxels along y, x, z.
    windows : array (6,)
        min_x, max_x, min_y, max_y, min_z, max_z of the voxels' outer faces.

    Raises
    ------
    InputError
        The grid's axes are not along +x, +y, +z.
    """
    instance(grid, Grid, "grid")
    axes = grid.affine[:3, :3]
    if np.any(np.abs(axes - np.diag(grid.spacing)) > 1e-9 * grid.spacing.max()):
        raise InputError("format astra: its volumes lie along +x, +y, +z, and this grid's axes do not")
    corners = grid.corners()
    n_x, n_y, n_z = grid.shape
    windows = np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1).reshape(-1)
    return np.array([n_y, n_x, n_z]), windows


def _write(system: PinholeSystem, views: Views, path: Path, *, grid: Grid | None = None) -> None:
    n_v, n_u = views.shape
    arrays = {"det_row_count": n_v, "det_col_count": n_u, "vectors": cone_vectors(views)}
    if grid is not None:
        arrays["volume_counts"], arrays["volume_windows"] = volume_geometry(grid)
    write_arrays(path, arrays)


ASTRA = Format("astra", "ASTRA Toolbox: cone_vec vectors", SUFFIXES, _write)
