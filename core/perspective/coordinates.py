"""Points and lines under homogeneous transforms, such as those of `Views.perspective_matrices`."""

import numpy as np

from ..arrays import ArrayLike, Floats
from ..validation import real_array


def transform_points(matrix: ArrayLike, points: ArrayLike) -> Floats:
    """Points after a homogeneous transform: multiplied by its matrix, divided by the last number.

    Parameters
    ----------
    matrix : array (4, 4)
    points : array (…, 3)

    Returns
    -------
    array (…, 3)
        Infinite, or not a number, where a point is taken to infinity.
    """
    matrix = real_array(matrix, "transform", (4, 4))
    points = real_array(points, "points", (3,), batch=True)
    moved = points @ matrix[:, :3].T + matrix[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(moved[..., :3] / moved[..., 3:])


def line_through(first: ArrayLike, second: ArrayLike) -> Floats:
    """The lines through two points each, (…, 3), as Plücker matrices (…, 4, 4): ``a b^T - b a^T`` of homogeneous points."""
    points = (real_array(each, "points of a line", (3,), batch=True) for each in (first, second))
    a, b = (np.insert(each, 3, 1.0, axis=-1) for each in points)
    outer = a[..., :, None] * b[..., None, :]
    return outer - outer.swapaxes(-1, -2)


def transform_lines(matrix: ArrayLike, lines: ArrayLike) -> Floats:
    """Lines after a homogeneous transform `matrix` (4, 4), as Plücker matrices (…, 4, 4): ``H L H^T``.

    It is the line through what `transform_points` makes of the line's points, times a factor.
    """
    matrix = real_array(matrix, "transform", (4, 4))
    return np.asarray(matrix @ real_array(lines, "lines", (4, 4), batch=True) @ matrix.T)
