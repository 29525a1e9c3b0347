"""LEAP (LLNL): the arguments of ``set_modularbeam`` (https://leapct.readthedocs.io/en/latest/ctgeometries.html)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.views import Views
from .camera_model import pixel_axes, with_common_pitch
from .format import array_format


def _arrays(views: Views) -> dict[str, Any]:
    """``rowVectors`` point to the next row, ``colVectors`` to the next column; all modules have one pixel size."""
    views, (width, height) = with_common_pitch(views, "leap")
    _, (columns, rows) = pixel_axes(views)
    n_v, n_u = views.shape
    return {
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


LEAP = array_format("leap", "LEAP: modular-beam geometry", _arrays)
