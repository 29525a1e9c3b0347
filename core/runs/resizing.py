"""Pictures in other sizes."""

import numpy as np

from ..arrays import ArrayLike, Floats, Floats32


def resized(picture: ArrayLike, rows: int, columns: int) -> Floats32:
    """A picture (h, w, channels) as (rows, columns, channels): each new pixel is the mean of what it covers."""
    tall = _along_rows(np.asarray(picture, np.float64), rows)
    return _along_rows(tall.swapaxes(0, 1), columns).swapaxes(0, 1).astype(np.float32)


def _along_rows(picture: Floats, rows: int) -> Floats:
    before = len(picture)
    sums = np.concatenate([np.zeros_like(picture[:1]), picture.cumsum(axis=0)])
    edges = np.linspace(0.0, before, rows + 1)
    below = np.minimum(edges.astype(int), before - 1)
    at_edges = sums[below] + (edges - below)[:, None, None] * picture[below]
    return np.diff(at_edges, axis=0) * (rows / before)
