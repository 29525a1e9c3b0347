"""Points and lines under homogeneous 4 x 4 transforms, such as those of `Views.perspective_matrices`."""

import numpy as np

from ..arrays import ArrayLike, Floats
from ..validation import real_array


def transform_points(matrix: ArrayLike, points: ArrayLike) -> Floats:
    """Apply a homogeneous transform to points: multiply by its matrix, then divide by the fourth coordinate.

    Parameters
    ----------
    matrix : array (4, 4)
    points : array (…, 3)

    Returns
    -------
    array (…, 3)
        Infinite or NaN for a point that the transform takes to infinity.
    """
    matrix = real_array(matrix, "transform", (4, 4))
    points = real_array(points, "points", (3,), batch=True)
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[..., :3] / homogeneous[..., 3:])


def line_through(first: ArrayLike, second: ArrayLike) -> Floats:
    """Return the lines through pairs of points (…, 3) as Plücker matrices (…, 4, 4).

    The matrix is ``a b^T - b a^T`` of the homogeneous points a and b.
    """
    points = (real_array(point, "points of a line", (3,), batch=True) for point in (first, second))
    a, b = (np.insert(point, 3, 1.0, axis=-1) for point in points)
    outer = a[..., :, None] * b[..., None, :]
    return outer - outer.swapaxes(-1, -2)


def transform_lines(matrix: ArrayLike, lines: ArrayLike) -> Floats:
    """Apply a homogeneous transform H (4, 4) to lines given as Plücker matrices L (…, 4, 4): ``H L H^T``.

    The result is, up to a factor, the line through the line's points after `transform_points`.
    """
    matrix = real_array(matrix, "transform", (4, 4))
    return np.asarray(matrix @ real_array(lines, "lines", (4, 4), batch=True) @ matrix.T)
