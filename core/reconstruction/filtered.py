"""Filtered backprojection shared by FBP and FDK: weight the images, filter them row by row, and backproject them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import require
from ..perspective.places import gather
from ..progress import Progress, tell
from ..rays.parallel import run_all, thread_count
from ..validation import instance, real_array
from .loop import plain
from .ramp import ramp_matrix

_BYTES_AT_ONCE = 2**26
"""Filtered images that are held at once."""

_BEHIND = 1e-3
"""Nothing is taken that is nearer to the source than this share of its distance from the detector."""

_SMALL_GAP, _OUTSTANDING = np.radians(20), 3
"""A gap between neighbouring views belongs to their spacing if it is at most so large, or so many times the usual one."""

_EQUAL = 1e-6
"""Angles that differ by less, as a share of the turn, are equal."""

_FALLEN, _BY_NOISE = 0.05, 6
"""Images have fallen to 0 where they are less than this share of the largest value, or so many deviations of the noise."""

_MOST_TILT = np.radians(15)
"""The largest angle between an image's rows and the plane in which the views turn."""


def checked_images(images: ArrayLike, quantity: str | None, views: Views, grid: Grid, name: str) -> tuple[Array, str]:
    """Return `images` as float32 (M, n_v, n_u) and the quantity of the volume to reconstruct."""
    quantity = str(quantity or getattr(images, "quantity", "mu"))
    instance(views, Views, f"{name}: views")
    instance(grid, Grid, f"{name}: grid")
    if len(views) < 2:
        raise InputError(f"{name}: expected two views or more, got {len(views)}")
    return real_array(plain(images), f"{name}: images", (len(views), *views.shape), np.float32), quantity


def rows_across(images: Array, views: Views, axis: Array, name: str) -> tuple[Array, Views]:
    """Return images and views whose rows lie about in the plane normal to `axis` (3,), rows and columns swapped if needed.

    Warns where the images do not fall to about 0 at their edge columns.
    """
    along_rows, along_columns = (
        np.abs(steps @ axis) / np.linalg.norm(steps, axis=1) for steps in (views.u_steps, views.v_steps)
    )
    if along_columns.max() < along_rows.min():
        turned = replace(views, u_steps=views.v_steps, v_steps=views.u_steps, shape=views.shape[::-1])
        images, views, along_rows = images.swapaxes(1, 2), turned, along_columns
    worst = int(along_rows.argmax())
    if along_rows[worst] > np.sin(_MOST_TILT):
        raise InputError(
            f"{name}: view {worst}: its rows are tilted by {np.degrees(np.arcsin(along_rows[worst])):.0f} degrees against "
            f"the plane in which the views turn, more than {np.degrees(_MOST_TILT):.0f}: turn the images, or use sirt"
        )
    _warn_of_cut(images, name)
    return images, views


def _warn_of_cut(images: Array, name: str) -> None:
    """Warn where the images do not fall to about 0 at their edge columns: the filter takes what is beyond them for 0."""
    edges = np.stack([images[:, :, :4], images[:, :, :-5:-1]], axis=-2, dtype=float)  # (M, n_v, 2, 4), outermost first
    noise = np.sqrt(np.mean(np.diff(edges, 3) ** 2) / 20)  # neither values nor slopes count in third differences
    largest, outermost = float(np.abs(images).max()), edges[..., :2].mean(axis=-1)
    for means in (outermost, outermost.mean(axis=1), outermost.mean(axis=(0, 1))):  # pixels, views, both edges
        found = float(np.abs(means).max())
        if found > max(_FALLEN * largest, _BY_NOISE * noise * np.sqrt(means.size / outermost.size / 2)):
            share = f"{found / largest:.0%} of their largest value"
            beyond = "what is beyond is missing, and values are wrong"
            return warn(f"{name}: the images fall only to {share} at their edge columns: {beyond}", 4)


def filtered_backprojection(
    images: Array,
    views: Views,
    grid: Grid,
    window: str,
    weights: Callable[[int], Array | float],
    progress: Progress | None = None,
) -> Array:
    """Return the sum over views of the filtered images ``images[m] * weights(m)`` at the voxels, divided by depth^2."""
    n, (n_v, n_u) = len(images), views.shape
    matrices = views.projection_matrices()
    beyond = _columns_beyond(matrices, grid, n_u)
    matrix = ramp_matrix(n_u, window, beyond)
    column, row, depth = np.moveaxis(matrices, 1, 0)
    # Images have a margin of zeros, so that beyond their edge they fall to 0 over one pixel.
    of_place = np.stack([row + depth, column + (beyond + 1) * depth, 0 * depth, depth, 0 * depth], axis=1) @ grid.affine
    bytes_of_a_view = 4 * n_v * (matrix.shape[1] + n_u)
    at_once = int(np.clip(_BYTES_AT_ONCE // bytes_of_a_view, 1, n))
    require(4 * grid.n_voxels + at_once * bytes_of_a_view, f"a volume of {' x '.join(map(str, grid.shape))} voxels")
    volume = np.zeros(grid.shape, np.float32)
    room = np.zeros((at_once, n_v + 2, matrix.shape[1] + 2, 1), np.float32)
    inside = room[:, 1:-1, 1:-1, 0]
    planes = np.arange(grid.shape[2], dtype=np.float64)
    tell(progress, 0, n)
    for first in range(0, n, at_once):
        end = min(first + at_once, n)

        def filter_view(m: int, first: int = first) -> None:
            inside[m - first] = (images[m] * weights(m)).astype(np.float32, copy=False) @ matrix

        run_all(filter_view, range(first, end), thread_count(None))
        taken = room[: end - first], of_place[first:end]
        gather(volume, planes, *taken, flat=True, by_depth=True, nearest=_BEHIND)
        tell(progress, end, n)
    return volume


def _columns_beyond(matrices: Array, grid: Grid, n_u: int) -> int:
    """Return the number of columns by which voxels lie beside the images, at most as many as the images have.

    There filtered images are not 0, and an object that lies within the images has values around it that cancel out.
    """
    column, _, depth = np.einsum("mij,pj->imp", matrices, np.insert(grid.corners(), 3, 1.0, axis=1))
    if (depth < 1e-3).any():
        return n_u
    column /= depth
    return int(np.clip(np.ceil(max(-column.min(), column.max() - (n_u - 1))), 0, n_u))


def angular_weights(angles: Array, turn: float) -> tuple[Array, float, float]:
    """Return the angular weights (M,) of views on a circle of circumference `turn`, the first angle, and the gap.

    Equal angles share alike what one of them would stand for. Then the first angle after the largest gap, and that gap, if
    there is one: a gap that is large and far larger than most of the others is an end and a beginning, and not half of it is
    added to these. Else the gap is 0.
    """
    order = np.argsort(angles % turn, kind="stable")
    angles = (angles % turn)[order]
    gaps = np.diff(angles, append=angles[0] + turn)  # from each to the next
    is_first = np.roll(gaps, 1) > _EQUAL * turn  # of equal ones
    which = np.cumsum(is_first) % is_first.sum()
    widest = int(gaps.argmax())
    gap, others = float(gaps[widest]), np.sort(np.delete(gaps, widest))
    usual = float(others[np.searchsorted(others.cumsum(), others.sum() / 2)])  # half of the rest is in gaps as large
    if gap > max(_SMALL_GAP, _OUTSTANDING * usual):
        gaps[widest] = usual
    else:
        gap = 0.0
    shares = np.empty(len(angles))
    shares[order] = (np.bincount(which, (gaps + np.roll(gaps, 1)) / 2) / np.bincount(which))[which]
    return shares, float(angles[(widest + 1) % len(angles)]), gap
