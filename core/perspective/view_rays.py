"""Rays of views' pixels and the pixels of points, for any pixel steps: skewed, mirrored, of other lengths along u and v."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, ArrayLike, Floats, Indexes
from ..errors import InputError, expecting
from ..geometry.frames import cross_matrix
from ..geometry.views import Views
from ..validation import instance, real_array

Indices = int | Sequence[int] | NDArray[np.integer[Any]]


def view_indices(views: Views, which: Indices, name: str) -> Indexes:
    """Indices of views as an array of indices from 0, or `InputError`; negative ones count from the end."""
    instance(views, Views, f"{name}: views")
    index = np.asarray(which)
    if index.dtype.kind not in "iu":
        raise InputError(f"{name}: expected the index of a view, got {which!r}")
    index = index.astype(np.intp)
    outside = (index < -len(views)) | (index >= len(views))
    if outside.any():
        raise InputError(f"{name}: there is no view {index[outside].flat[0]} among {len(views)}")
    return index % len(views)


def broadcast(first: Array, second: Array, expected: str) -> tuple[Array, Array]:
    """Two arrays made of one shape, or `InputError` with what is `expected`."""
    with expecting(f"{expected}, or one for all, got {first.size} and {second.size}"):
        one, other = np.broadcast_arrays(first, second)
    return one, other


def view_frames(views: Views) -> Floats:
    """The views' frames (M, 3, 3), rows u, v, k: unit vectors, right-handed, whatever the pixels are.

    k is across the detector's plane and leads from the source towards it; u is along the views' `u_steps`, ``v = k x u``.
    `PinholeSystem.frames` for a scanner's virtual detectors; for its real ones, turned by 180 degrees about k. Where pixels
    are mirrored, rows go along -v.
    """
    instance(views, Views, "frames: views")
    u = views.u_steps / np.linalg.norm(views.u_steps, axis=1, keepdims=True)
    k = np.cross(u, views.v_steps)
    ahead = np.einsum("mi,mi->m", k, views.detector_centers - views.sources)
    k *= (np.sign(ahead) / np.linalg.norm(k, axis=1))[:, None]
    return np.stack([u, np.cross(k, u), k], axis=1)


def intrinsic_matrices(views: Views) -> Floats:
    """Matrices K (M, 3, 3) with ``(column, row, 1) = K (u / depth, v / depth, 1)``: upper triangular, the last number 1.

    u, v and depth, mm, are a point's coordinates from the source in the view's frame (`view_frames`). K holds the distance
    from source to detector in pixels, along columns and rows, the skew, and the principal point, which is the pixel of the
    foot of the perpendicular from the source. ``K[1, 1]`` is negative where pixels are mirrored.

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
    """The pixels (M, N, 2), column and row, where the views have world points (N, 3), mm; NaN behind a view's source.

    They need not lie in the image, which ends half a pixel beyond the centres of the outermost pixels.
    """
    instance(views, Views, "project_points: views")
    points = real_array(points, "points", (None, 3))
    pixels = [pixels_of(matrix, points) for matrix in views.projection_matrices()]
    return np.reshape(pixels, (len(views), len(points), 2))


def pixels_of(matrix: Floats, points: Floats) -> Floats:
    """Pixels (…, 2) of world points (…, 3) by one projection matrix (3, 4); NaN behind the source."""
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(homogeneous[..., 2:] > 0, homogeneous[..., :2] / homogeneous[..., 2:], np.nan)


def points_at_depths(views: Views, m: int, pixels: ArrayLike, depths: ArrayLike) -> Floats:
    """World points (…, 3), mm, on the rays of view m's `pixels` (…, 2), column and row, at `depths` (…), mm.

    The depth is measured across the detector's plane from the source, in parallel views from the plane through
    ``views.sources[m]``: it is that of a `PerspectiveGrid`, ``D / k``. Both arguments broadcast. Pixels need be neither
    whole numbers nor in the image.
    """
    index = view_indices(views, m, "points at depths")
    starts, per_depth = rays_by_depth(views, int(index), real_array(pixels, "pixels", (2,), batch=True))
    steps = real_array(depths, "depths", None)[..., None]
    broadcast(steps, per_depth[..., :1], "points at depths: expected as many depths as pixels")
    return np.asarray(starts + steps * per_depth)


def rays_by_depth(views: Views, m: int | Indexes, pixels: Floats) -> tuple[Floats, Floats]:
    """For pixels (…, 2): where their rays begin, at depth 0, and how far they lead per mm of depth: (…, 3) each.

    m is the view of all pixels, or an array that broadcasts with them.
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
    """Matrices (…, 3, 3) from (column, row, 1) to the direction and the moment about `origin` (…, 3) of a pixel's ray.

    The direction is, in mm, the vector from the source to the pixel's place on the detector, and in parallel views, for all
    pixels, to the detector's centre. The moment is the vector from `origin` to any point of the ray, crossed with it.
    """
    to_detector = _to_detector(views)[m]
    if not views.parallel:
        return to_detector, cross_matrix(views.sources[m] - origin) @ to_detector
    direction = views.detector_centers[m] - views.sources[m]
    directions = np.zeros_like(to_detector)
    directions[..., 2] = direction
    places = to_detector.copy()
    places[..., 2] += views.sources[m] - origin
    return directions, -cross_matrix(direction) @ places


def _to_detector(views: Views) -> Floats:
    """(M, 3, 3): from (column, row, 1) to the vector, mm, from the source to that place on the detector."""
    n_v, n_u = views.shape
    first = views.detector_centers - views.sources - (n_u - 1) / 2 * views.u_steps - (n_v - 1) / 2 * views.v_steps
    return np.stack([views.u_steps, views.v_steps, first], axis=2)
