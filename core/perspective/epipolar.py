"""Epipolar geometry: where one view must have what another view's pixel shows.

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

# What is less than this share of what it is the difference of, is rounding.
_ROUNDING = 1e-12


def fundamental_matrix(views: Views, m: Indices, n: Indices) -> Floats:
    """The matrix F with ``x_n^T F x_m = 0`` for all points that view m has at x_m and view n at x_n.

    Pixels are homogeneous, ``x = (column, row, 1)``. For any two pixels ``x_n^T F x_m`` is, in mm^3 and with a sign, the
    distance of their rays times ``|d_m x d_n|``, where d leads from the source to the pixel's place on the detector (in
    parallel views, to the detector's centre). ``F x_m`` is the epipolar line in view n, see `epipolar_lines`;
    ``F e = 0`` for the epipole e in view m. F of (n, m) is the transpose.

    Parameters
    ----------
    views : Views
        Pinhole or parallel ones.
    m, n : int or arrays of int
        Two of them; or many pairs, as arrays that broadcast.

    Returns
    -------
    array (…, 3, 3)

    Raises
    ------
    InputError
        The two have the same source: each point has one ray in both.
    """
    first, second = _pair(views, m, n, "fundamental matrix")
    if views.parallel:
        middles = (views.sources + views.detector_centers) / 2
        origin = (middles[first] + middles[second]) / 2
    else:
        origin = (views.sources[first] + views.sources[second]) / 2
    directions_m, moments_m = lines_of_pixels(views, first, origin)
    directions_n, moments_n = lines_of_pixels(views, second, origin)
    return np.asarray(directions_n.swapaxes(-1, -2) @ moments_m + moments_n.swapaxes(-1, -2) @ directions_m)


def essential_matrix(views: Views, m: Indices, n: Indices) -> Floats:
    """The matrix E with ``y_n^T E y_m = 0`` where ``y = (u / depth, v / depth, 1)`` of one point in each view's frame.

    ``E = [t]x R``, mm: a point at X_m in view m's frame, from its source, is at ``X_n = R X_m + t`` in view n's. The frames
    are `view_frames`, and ``y = inv(K) x`` with `intrinsic_matrices` K. Its singular values are the distance of the sources,
    twice, and 0.

    Parameters
    ----------
    views : Views
    m, n : int or arrays of int
        Two of them; or many pairs, as arrays that broadcast.

    Returns
    -------
    array (…, 3, 3)

    Raises
    ------
    InputError
        The two have the same source, or the views are parallel.
    """
    first, second = _pair(views, m, n, "essential matrix")
    views.require_pinholes("essential matrix")
    frames = view_frames(views)
    between = cross_matrix(views.sources[first] - views.sources[second])
    return np.asarray(frames[second] @ between @ frames[first].swapaxes(-1, -2))


def epipole(views: Views, m: Indices, n: Indices) -> Floats:
    """Where view n has the source of view m: homogeneous (…, 3), ``(column, row, 1)`` times the last number.

    That number is the depth of view m's source in view n, in units of view n's distance from source to detector. Above 0,
    view n looks towards the source, and ``e[:2] / e[2]`` is its pixel, in the image or not. Below 0 the source is behind
    view n's: all epipolar lines go through that pixel, but it does not show the source. At 0 the epipole is at infinity, in
    the direction ``e[:2]``, and epipolar lines are parallel; in parallel views this is always so.

    m and n are indices of views, or arrays of them that broadcast.

    Raises
    ------
    InputError
        The two have the same source.
    """
    first, second = _pair(views, m, n, "epipole")
    matrices = views.projection_matrices()[second]
    if views.parallel:
        towards = (views.sources - views.detector_centers)[first]
        return np.einsum("...ij,...j->...i", matrices[..., :3], towards) * [1.0, 1.0, 0.0]
    # The matrix takes view n's own source to 0: from there, nothing cancels.
    return np.einsum("...ij,...j->...i", matrices[..., :3], views.sources[first] - views.sources[second])


def epipolar_lines(views: Views, m: int, n: int, pixels: ArrayLike) -> Floats:
    """The lines (…, 3) in view n on which it has what view m has at `pixels` (…, 2), column and row.

    A line is (a, b, c) with ``a^2 + b^2 = 1``, so that ``a column + b row + c`` is, with a sign, a pixel's distance from it,
    in pixels. NaN where there is no line: the ray leads through view n's source, or the line is at infinity.
    """
    matrix = fundamental_matrix(views, m, n)
    if matrix.ndim != 2:
        raise InputError("epipolar lines: expected one index m and one index n")
    pixels = real_array(pixels, "pixels", (2,), batch=True)
    lines = pixels @ matrix[:, :2].T + matrix[:, 2]
    length = np.hypot(lines[..., 0], lines[..., 1])
    # Numbers of the size of what was summed: columns and rows of an image are about its sides.
    largest = (np.abs(pixels) @ np.abs(matrix[:2, :2]).T + np.abs(matrix[:2, 2])).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((length > _ROUNDING * largest)[..., None], lines / length[..., None], np.nan)


def epipolar_segments(views: Views, m: int, pixel: ArrayLike, near: float, far: float = math.inf) -> Floats:
    """What all views see of the ray of one `pixel` of view m: the ends (M, 2, 2) of its image in each, (column, row).

    Parameters
    ----------
    views : Views
    m : int
    pixel : array (2,)
        Column and row, in the image or not.
    near, far : float
        Depths, mm, in view m where the ray begins and ends: from its source, in parallel views from the plane through
        ``views.sources[m]``. `far` may be infinite, for a ray without an end.

    Returns
    -------
    array (M, 2, 2)
        The end next to `near` first. What does not lie in front of a view's source and in its image, up to the edges of the
        outermost pixels at -0.5 and n - 0.5, is cut off; NaN where nothing is left. In view m itself both ends are the
        pixel; in views whose source is on the ray they are one pixel, too.

    Raises
    ------
    InputError
        Depths are not in this order or begin behind the source.
    """
    index = view_indices(views, m, "epipolar segments")
    if index.ndim:
        raise InputError("epipolar segments: expected one index m")
    pixel = real_array(pixel, "pixel", (2,))
    near = float(real_array(near, "near", ()))
    far = float(far) if far == math.inf else float(real_array(far, "far", ()))
    if near > far or (near < 0 and not views.parallel):
        least = "" if views.parallel else "0 <= "
        raise InputError(f"epipolar segments: expected depths {least}near <= far, got {near:g} and {far:g} mm")
    start, per_depth = rays_by_depth(views, int(index), pixel)
    first = np.append(start + near * per_depth, 1.0)
    last = np.append(per_depth, 0.0) if far == math.inf else np.append(start + far * per_depth, 1.0)
    # (M, 2, 3): all images between are sums of these two with weights of at least 0.
    matrices, both = views.projection_matrices(), np.stack([first, last])
    # What the last number was summed of: against it, that of a source is rounding.
    scale = np.einsum("mj,ej->me", np.abs(matrices[:, 2]), np.abs(both))
    ends = _within_image(np.einsum("mij,ej->mei", matrices, both), scale, views.shape)
    in_image = (pixel >= -0.5).all() and (pixel <= np.array(views.shape[::-1]) - 0.5).all()
    ends[index] = pixel if in_image else np.nan
    return ends


def _within_image(ends: Floats, scale: Floats, shape: tuple[int, int]) -> Floats:
    """Pixels (M, 2, 2) of the part in the image of segments between homogeneous pixels (M, 2, 3).

    A last number is 0 if it is a rounding error beside `scale` (M, 2).
    """
    column, row, factor = np.moveaxis(ends, -1, 0)
    n_v, n_u = shape
    # At least 0 in the image: linear along a segment. In front of the source follows from the sum of two.
    half = 0.5 * factor
    bounds = np.stack([column + half, (n_u - 0.5) * factor - column, row + half, (n_v - 0.5) * factor - row])
    at_first, at_last = bounds[..., 0], bounds[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = at_first / (at_first - at_last)
    enter = np.where((at_first < 0) & (at_last >= 0), crossing, 0.0).max(axis=0)
    leave = np.where((at_first >= 0) & (at_last < 0), crossing, 1.0).min(axis=0)
    empty = ((at_first < 0) & (at_last < 0)).any(axis=0) | (enter > leave)
    share = np.stack([enter, leave], axis=1)[..., None]
    clipped = (1 - share) * ends[:, :1] + share * ends[:, 1:]
    # In the image the last number is 0 at the source alone; a ray through there has one pixel.
    at_source = clipped[..., 2] <= _ROUNDING * scale.max(axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = clipped[..., :2] / clipped[..., 2:]
    pixels = np.where(at_source[..., None], pixels[:, ::-1], pixels)
    empty |= at_source.all(axis=1)
    return np.where(empty[:, None, None], np.nan, np.clip(pixels, -0.5, [n_u - 0.5, n_v - 0.5]))


def _pair(views: Views, m: Indices, n: Indices, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Indices of two views that have not the same source, or of many pairs, of one shape."""
    instance(views, Views, f"{name}: views")
    first, second = view_indices(views, m, name), view_indices(views, n, name)
    first, second = broadcast(first, second, f"{name}: expected as many views m as n")
    if views.parallel:
        directions = views.detector_centers - views.sources
        apart = np.linalg.norm(np.cross(directions[first], directions[second]), axis=-1)
        size = np.linalg.norm(directions, axis=1)[first] * np.linalg.norm(directions, axis=1)[second]
        what = "look in the same or the opposite direction"
    else:
        apart = np.linalg.norm(views.sources[first] - views.sources[second], axis=-1)
        size = np.abs(views.sources[first]).max(axis=-1) + np.abs(views.sources[second]).max(axis=-1)
        what = "have the same source"
    same = ~(apart > _ROUNDING * size)
    if same.any():
        i, j = int(first[same].flat[0]), int(second[same].flat[0])
        which = f"view {i} twice" if i == j else f"views {i} and {j}, which {what}"
        raise InputError(f"{name}: expected two views whose rays differ, got {which}")
    return first, second
