"""Epipolar geometry: the line in one view on which a point lies that is at a given pixel of another view.

A ray is a line with a direction d and a moment m, both linear in the homogeneous pixel (column, row, 1); two lines meet
where ``d_1 . m_2 + m_1 . d_2 = 0``. So one formula holds for pinholes and for parallel rays.

References
----------
R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., Cambridge University Press (2004),
chapter 9.
"""

import math

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..geometry.frames import cross_matrix
from ..geometry.views import Views
from ..validation import instance, real_array
from .view_rays import Indices, broadcast, lines_of_pixels, rays_by_depth, view_frames, view_indices

# Differences below this share of their terms are rounding errors.
_ROUNDING = 1e-12


def fundamental_matrix(views: Views, m: Indices, n: Indices) -> Floats:
    """Return the fundamental matrix F: ``x_n^T F x_m = 0`` for every point with pixel x_m in view m and x_n in view n.

    Pixels are homogeneous, ``x = (column, row, 1)``. For any two pixels ``x_n^T F x_m`` is, in mm^3 and with a sign, the
    distance of their rays times ``|d_m x d_n|``, where d leads from the source to the pixel on the detector (in parallel
    views, to the detector's centre). ``F x_m`` is the epipolar line in view n, see `epipolar_lines`; ``F e = 0`` for the
    epipole e in view m. F of (n, m) is the transpose.

    Parameters
    ----------
    views : Views
        Pinhole or parallel views.
    m, n : int or arrays of int
        Indices of two views, or of many pairs as arrays that broadcast.

    Returns
    -------
    array (…, 3, 3)

    Raises
    ------
    InputError
        Both views have the same source: each point has the same ray in both.
    """
    first, second = _pair(views, m, n, "fundamental matrix")
    if views.parallel:
        centers = (views.sources + views.detector_centers) / 2
        origin = (centers[first] + centers[second]) / 2
    else:
        origin = (views.sources[first] + views.sources[second]) / 2
    directions_m, moments_m = lines_of_pixels(views, first, origin)
    directions_n, moments_n = lines_of_pixels(views, second, origin)
    return np.asarray(directions_n.swapaxes(-1, -2) @ moments_m + moments_n.swapaxes(-1, -2) @ directions_m)


def essential_matrix(views: Views, m: Indices, n: Indices) -> Floats:
    """Return the essential matrix E: ``y_n^T E y_m = 0`` for every point with y_m in view m's frame and y_n in view n's.

    Here ``y = (u / depth, v / depth, 1)``. ``E = [t]x R``, mm: a point at X_m in view m's frame, from its source, is at
    ``X_n = R X_m + t`` in view n's. The frames are `view_frames`, and ``y = inv(K) x`` with `intrinsic_matrices` K. The
    singular values of E are the distance of the sources, twice, and 0.

    Parameters
    ----------
    views : Views
    m, n : int or arrays of int
        Indices of two views, or of many pairs as arrays that broadcast.

    Returns
    -------
    array (…, 3, 3)

    Raises
    ------
    InputError
        Both views have the same source, or the views are parallel.
    """
    first, second = _pair(views, m, n, "essential matrix")
    views.require_pinholes("essential matrix")
    frames = view_frames(views)
    translation = cross_matrix(views.sources[first] - views.sources[second])
    return np.asarray(frames[second] @ translation @ frames[first].swapaxes(-1, -2))


def epipole(views: Views, m: Indices, n: Indices) -> Floats:
    """Return the image of view m's source in view n: homogeneous (…, 3), ``(column, row, 1)`` times the third number.

    The third number is the depth of view m's source in view n, in units of view n's distance from source to detector. Above
    0, view n looks towards the source, and ``e[:2] / e[2]`` is its pixel, in the image or not. Below 0 the source is behind
    view n's: all epipolar lines pass through that pixel, but it does not show the source. At 0 the epipole is at infinity,
    in the direction ``e[:2]``, and epipolar lines are parallel; in parallel views this is always so.

    m and n are indices of views, or arrays of them that broadcast.

    Raises
    ------
    InputError
        Both views have the same source.
    """
    first, second = _pair(views, m, n, "epipole")
    matrices = views.projection_matrices()[second]
    if views.parallel:
        to_source = (views.sources - views.detector_centers)[first]
        return np.einsum("...ij,...j->...i", matrices[..., :3], to_source) * [1.0, 1.0, 0.0]
    # The matrix takes view n's source to 0, so positions relative to it lose no digits.
    return np.einsum("...ij,...j->...i", matrices[..., :3], views.sources[first] - views.sources[second])


def epipolar_lines(views: Views, m: int, n: int, pixels: ArrayLike) -> Floats:
    """Return the epipolar lines (…, 3) in view n of view m's `pixels` (…, 2), column and row.

    A line is (a, b, c) with ``a^2 + b^2 = 1``, so that ``a column + b row + c`` is a pixel's signed distance from the line,
    in pixels. NaN where there is no line: the ray passes through view n's source, or the line is at infinity.
    """
    matrix = fundamental_matrix(views, m, n)
    if matrix.ndim != 2:
        raise InputError("epipolar lines: expected one index m and one index n")
    pixels = real_array(pixels, "pixels", (2,), batch=True)
    lines = pixels @ matrix[:, :2].T + matrix[:, 2]
    norm = np.hypot(lines[..., 0], lines[..., 1])
    # The size of the terms that a and b are sums of, against which a and b may be rounding errors.
    scale = (np.abs(pixels) @ np.abs(matrix[:2, :2]).T + np.abs(matrix[:2, 2])).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((norm > _ROUNDING * scale)[..., None], lines / norm[..., None], np.nan)


def epipolar_segments(views: Views, m: int, pixel: ArrayLike, near: float, far: float = math.inf) -> Floats:
    """Project the ray of one `pixel` of view m into all views and clip it to each image; return end points (M, 2, 2).

    Parameters
    ----------
    views : Views
    m : int
    pixel : array (2,)
        Column and row, in the image or not.
    near, far : float
        Depths, mm, in view m at which the ray begins and ends: from its source, in parallel views from the plane through
        ``views.sources[m]``. `far` may be infinite, for a ray without an end.

    Returns
    -------
    array (M, 2, 2)
        End points (column, row); the one next to `near` is first. Parts behind a view's source or outside its image, which
        ends at the edges of the outermost pixels at -0.5 and n - 0.5, are cut off; NaN where nothing remains. In view m
        itself both ends are the pixel; in a view whose source is on the ray both ends are one pixel, too.

    Raises
    ------
    InputError
        The depths are not in this order or begin behind the source.
    """
    index = view_indices(views, m, "epipolar segments")
    if index.ndim:
        raise InputError("epipolar segments: expected one index m")
    pixel = real_array(pixel, "pixel", (2,))
    near = float(real_array(near, "near", ()))
    far = float(far) if far == math.inf else float(real_array(far, "far", ()))
    if near > far or (near < 0 and not views.parallel):
        lower = "" if views.parallel else "0 <= "
        raise InputError(f"epipolar segments: expected depths {lower}near <= far, got {near:g} and {far:g} mm")
    start, per_depth = rays_by_depth(views, int(index), pixel)
    first = np.append(start + near * per_depth, 1.0)
    last = np.append(per_depth, 0.0) if far == math.inf else np.append(start + far * per_depth, 1.0)
    # Pixels of the points between the two ends are sums of the ends' homogeneous pixels with weights of at least 0.
    matrices, points = views.projection_matrices(), np.stack([first, last])
    # The size of the terms of the third number, against which that of a source is a rounding error.
    scale = np.einsum("mj,ej->me", np.abs(matrices[:, 2]), np.abs(points))
    ends = _clip_to_image(np.einsum("mij,ej->mei", matrices, points), scale, views.shape)
    in_image = (pixel >= -0.5).all() and (pixel <= np.array(views.shape[::-1]) - 0.5).all()
    ends[index] = pixel if in_image else np.nan
    return ends


def _clip_to_image(ends: Floats, scale: Floats, shape: tuple[int, int]) -> Floats:
    """Clip segments between homogeneous pixels (M, 2, 3) to the image and return their ends as pixels (M, 2, 2), or NaN.

    A third number that is a rounding error beside `scale` (M, 2) is treated as 0.
    """
    column, row, factor = np.moveaxis(ends, -1, 0)
    n_v, n_u = shape
    # Linear along a segment and all >= 0 in the image. Two opposite ones sum to a multiple of `factor`, so it is >= 0, too.
    half = 0.5 * factor
    bounds = np.stack([column + half, (n_u - 0.5) * factor - column, row + half, (n_v - 0.5) * factor - row])
    at_first, at_last = bounds[..., 0], bounds[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = at_first / (at_first - at_last)
    enter = np.where((at_first < 0) & (at_last >= 0), crossing, 0.0).max(axis=0)
    leave = np.where((at_first >= 0) & (at_last < 0), crossing, 1.0).min(axis=0)
    empty = ((at_first < 0) & (at_last < 0)).any(axis=0) | (enter > leave)
    fraction = np.stack([enter, leave], axis=1)[..., None]
    clipped = (1 - fraction) * ends[:, :1] + fraction * ends[:, 1:]
    # Within the image the third number is 0 at the source only; a ray through the source has a single pixel.
    at_source = clipped[..., 2] <= _ROUNDING * scale.max(axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = clipped[..., :2] / clipped[..., 2:]
    pixels = np.where(at_source[..., None], pixels[:, ::-1], pixels)
    empty |= at_source.all(axis=1)
    return np.where(empty[:, None, None], np.nan, np.clip(pixels, -0.5, [n_u - 0.5, n_v - 0.5]))


def _pair(views: Views, m: Indices, n: Indices, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of two views with different sources, or of many pairs, as two arrays of one shape.

    Raises `InputError`, which begins with `name`, for two views with the same rays.
    """
    instance(views, Views, f"{name}: views")
    first, second = view_indices(views, m, name), view_indices(views, n, name)
    first, second = broadcast(first, second, f"{name}: expected as many views m as n")
    if views.parallel:
        directions = views.detector_centers - views.sources
        distance = np.linalg.norm(np.cross(directions[first], directions[second]), axis=-1)
        size = np.linalg.norm(directions, axis=1)[first] * np.linalg.norm(directions, axis=1)[second]
        relation = "look in the same or the opposite direction"
    else:
        distance = np.linalg.norm(views.sources[first] - views.sources[second], axis=-1)
        size = np.abs(views.sources[first]).max(axis=-1) + np.abs(views.sources[second]).max(axis=-1)
        relation = "have the same source"
    is_same = ~(distance > _ROUNDING * size)
    if is_same.any():
        i, j = int(first[is_same].flat[0]), int(second[is_same].flat[0])
        pair = f"view {i} twice" if i == j else f"views {i} and {j}, which {relation}"
        raise InputError(f"{name}: expected two views whose rays differ, got {pair}")
    return first, second
