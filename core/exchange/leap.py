"""LEAP (LLNL): the arguments of ``set_modularbeam`` (https://leapct.readthedocs.io/en/latest/ctgeometries.html)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .arrays import SUFFIXES, write_arrays
from .cameras import pixel_axes, with_common_pitch
from .format import Format


def _write(system: PinholeSystem, views: Views, path: Path) -> None:
    """``rowVectors`` point to the next row and ``colVectors`` to the next column; one pixel size for all modules.

    LEAP counts in float32.
    """
    views, (width, height) = with_common_pitch(views, "leap")
    _, (columns, rows) = pixel_axes(views)
    n_v, n_u = views.shape
    arrays = {
        "numAngles": len(views),
        "numRows": n_v,
        "numCols": n_u,
        "pixelHeight": height,
        "pixelWidth": width,
        "sourcePositions": views.sources.astype(np.float32),
        "moduleCenters": views.detector_centers.astype(np.float32),
        "rowVectors": rows.astype(np.float32),
        "colVectors": columns.astype(np.float32),
    }
    write_arrays(path, arrays)


LEAP = Format("leap", "LEAP: modular-beam geometry", SUFFIXES, _write)
