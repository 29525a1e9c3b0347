"""Rays of pixels and pixels of points, for any pixel steps: skewed, mirrored, of different lengths along u and v."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, ArrayLike, Floats, Indexes
from ..errors import InputError, expecting
from ..geometry.frames import cross_matrix, unit_vectors
from ..geometry.views import Views
from ..validation import instance, real_array

Indices = int | Sequence[int] | NDArray[np.integer[Any]]


def view_indices(views: Views, indices: Indices, name: str) -> Indexes:
    """Return indices of views as an array of non-negative integers; negative ones count from the end.

    Raises `InputError`, which begins with `name`, unless all are integers and name existing views.
    """
    instance(views, Views, f"{name}: views")
    result = np.asarray(indices)
    if result.dtype.kind not in "iu":
        raise InputError(f"{name}: expected the index of a view, got {indices!r}")
    result = result.astype(np.intp)
    outside = (result < -len(views)) | (result >= len(views))
    if outside.any():
        raise InputError(f"{name}: there is no view {result[outside].flat[0]} among {len(views)}")
    return result % len(views)


def broadcast(first: Array, second: Array, expected: str) -> tuple[Array, Array]:
    """Return two arrays broadcast to a common shape, or raise `InputError`, which says what was `expected`."""
    with expecting(f"{expected}, or one for all, got {first.size} and {second.size}"):
        first, second = np.broadcast_arrays(first, second)
    return first, second


def view_frames(views: Views) -> Floats:
    """Return the views' frames (M, 3, 3), rows u, v, k: right-handed unit vectors, whatever the pixel steps are.

    k is the detector's normal that points from the source to the detector; u is along the views' `u_steps`, and ``v = k x
    u``. For a scanner's virtual detectors these are `PinholeSystem.frames`; for its real ones they are turned by 180 degrees
    about k. Where pixels are mirrored, rows run along -v.
    """
    instance(views, Views, "frames: views")
    u = unit_vectors(views.u_steps)
    k = np.cross(u, views.v_steps)
    distance = np.einsum("mi,mi->m", k, views.detector_centers - views.sources)
    k *= (np.sign(distance) / np.linalg.norm(k, axis=1))[:, None]
    return np.stack([u, np.cross(k, u), k], axis=1)


def intrinsic_matrices(views: Views) -> Floats:
    """Return the camera matrices K (M, 3, 3) with ``(column, row, 1) = K (u / depth, v / depth, 1)``.

    K is upper triangular with ``K[2, 2] = 1``. u, v and depth, mm, are a point's coordinates from the source in the view's
    frame (`view_frames`). K holds the distance from source to detector in pixels, along columns and rows, the skew, and the
    principal point, which is the pixel of the foot of the perpendicular from the source. ``K[1, 1]`` is negative where
    pixels are mirrored.

    Raises
    ------
    InputError
        The views are parallel: their sources are at infinity.

    References
    ----------
    R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., Cambridge University Press (2004),
    section 6.1.
    """
    instance(views, Views, "intrinsic matrices: views")
    views.require_pinholes("intrinsic matrices")
    matrices = np.triu(np.linalg.inv(view_frames(views) @ _to_detector(views)))
    return np.asarray(matrices / matrices[:, 2:, 2:])


def project_points(views: Views, points: ArrayLike) -> Floats:
    """Project world points (N, 3), mm, into all views: pixels (M, N, 2) as (column, row); NaN behind a view's source.

    A pixel need not lie in the image, which ends half a pixel beyond the centres of the outermost pixels.
    """
    instance(views, Views, "project_points: views")
    points = real_array(points, "points", (None, 3))
    pixels = [pixels_of(matrix, points) for matrix in views.projection_matrices()]
    return np.reshape(pixels, (len(views), len(points), 2))


def pixels_of(matrix: Floats, points: Floats) -> Floats:
    """Return the pixels (…, 2) of world points (…, 3) under one projection matrix (3, 4); NaN behind the source."""
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(homogeneous[..., 2:] > 0, homogeneous[..., :2] / homogeneous[..., 2:], np.nan)


def points_at_depths(views: Views, m: int, pixels: ArrayLike, depths: ArrayLike) -> Floats:
    """Return the world points (…, 3), mm, on the rays of view m's `pixels` (…, 2), column and row, at `depths` (…), mm.

    Depth is measured along the detector's normal from the source, in parallel views from the plane through
    ``views.sources[m]``, as in a `PerspectiveGrid`: ``D / k``. Both arguments broadcast. Pixels need be neither whole
    numbers nor in the image.
    """
    index = view_indices(views, m, "points at depths")
    starts, per_depth = rays_by_depth(views, int(index), real_array(pixels, "pixels", (2,), batch=True))
    steps = real_array(depths, "depths", None)[..., None]
    broadcast(steps, per_depth[..., :1], "points at depths: expected as many depths as pixels")
    return np.asarray(starts + steps * per_depth)


def rays_by_depth(views: Views, m: int | Indexes, pixels: Floats) -> tuple[Floats, Floats]:
    """Return the rays of pixels (…, 2) as starts at depth 0 and displacements per mm of depth, (…, 3) each.

    m is the index of one view for all pixels, or an array of indices that broadcasts with them.
    """
    to_detector, normal = _to_detector(views)[m], view_frames(views)[m, 2]
    on_detector = np.einsum("...ij,...j->...i", to_detector[..., :2], pixels) + to_detector[..., 2]  # from the source
    sources = np.broadcast_to(views.sources[m], on_detector.shape)
    if views.parallel:
        direction = views.detector_centers[m] - views.sources[m]
        per_depth = direction / np.einsum("...i,...i->...", normal, direction)[..., None]
        return sources + on_detector - direction, np.broadcast_to(per_depth, on_detector.shape)
    return sources, on_detector / np.einsum("...i,...i->...", on_detector, normal)[..., None]


def lines_of_pixels(views: Views, m: Indexes, origin: Floats) -> tuple[Floats, Floats]:
    """Return matrices (…, 3, 3) from (column, row, 1) to the direction and to the moment of a pixel's ray.

    The direction is, in mm, the vector from the source to the pixel on the detector; in parallel views it is, for all
    pixels, the vector from the source to the detector's centre. The moment is the vector from `origin` (…, 3) to any point
    of the ray, crossed with the direction.
    """
    to_detector = _to_detector(views)[m]
    if not views.parallel:
        return to_detector, cross_matrix(views.sources[m] - origin) @ to_detector
    direction = views.detector_centers[m] - views.sources[m]
    directions = np.zeros_like(to_detector)
    directions[..., 2] = direction
    points = to_detector.copy()
    points[..., 2] += views.sources[m] - origin
    return directions, -cross_matrix(direction) @ points


def _to_detector(views: Views) -> Floats:
    """Return matrices (M, 3, 3) from (column, row, 1) to the vector, mm, from the source to that pixel on the detector."""
    n_v, n_u = views.shape
    first = views.detector_centers - views.sources - (n_u - 1) / 2 * views.u_steps - (n_v - 1) / 2 * views.v_steps
    return np.stack([views.u_steps, views.v_steps, first], axis=2)
