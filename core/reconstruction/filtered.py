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
from .loop import numpy_if_tensor
from .ramp import ramp_matrix

_BATCH_BYTES = 2**26
"""Memory, bytes, of the filtered images that are held at once."""

_NEAREST_DEPTH = 1e-3
"""Smallest distance of a voxel from the source that receives values, as a share of the distance to the detector."""

_SMALL_GAP, _GAP_FACTOR = np.radians(20), 3
"""Largest gap between neighbouring views that counts as their spacing: an angle, or a multiple of the median gap."""

_ANGLE_TOLERANCE = 1e-6
"""Largest difference of two angles that count as equal, as a share of the turn."""

_NEGLIGIBLE_EDGE, _EDGE_DEVIATIONS = 0.05, 6
"""Largest edge value of an image that is not cut off: a share of the largest value, or a multiple of the noise."""

_MAX_TILT = np.radians(15)
"""Largest angle between an image's rows and the plane in which the views turn."""


def checked_images(images: ArrayLike, quantity: str | None, views: Views, grid: Grid, name: str) -> tuple[Array, str]:
    """Return `images` as float32 (M, n_v, n_u) and the quantity of the volume to reconstruct.

    Raise `InputError` unless there are two or more views, a grid, and images of the views' shape. `name` names the method
    in messages.
    """
    quantity = str(quantity or getattr(images, "quantity", "mu"))
    instance(views, Views, f"{name}: views")
    instance(grid, Grid, f"{name}: grid")
    if len(views) < 2:
        raise InputError(f"{name}: expected two views or more, got {len(views)}")
    return real_array(numpy_if_tensor(images), f"{name}: images", (len(views), *views.shape), np.float32), quantity


def rows_across(images: Array, views: Views, axis: Array, name: str) -> tuple[Array, Views]:
    """Return images and views whose rows lie about in the plane normal to `axis` (3,), rows and columns swapped if needed.

    Raise `InputError` if neither rows nor columns lie in that plane. Warn if the images do not fall to about 0 at their edge
    columns.
    """
    steps = np.stack([views.u_steps, views.v_steps])
    along_rows, along_columns = np.abs(steps @ axis) / np.linalg.norm(steps, axis=2)
    if along_columns.max() < along_rows.min():
        swapped = replace(views, u_steps=views.v_steps, v_steps=views.u_steps, shape=views.shape[::-1])
        images, views, along_rows = images.swapaxes(1, 2), swapped, along_columns
    worst = int(along_rows.argmax())
    if along_rows[worst] > np.sin(_MAX_TILT):
        raise InputError(
            f"{name}: view {worst}: its rows are tilted by {np.degrees(np.arcsin(along_rows[worst])):.0f} degrees against "
            f"the plane in which the views turn, more than {np.degrees(_MAX_TILT):.0f}: turn the images, or use sirt"
        )
    _warn_if_truncated(images, name)
    return images, views


def _warn_if_truncated(images: Array, name: str) -> None:
    """Warn if the images do not fall to about 0 at their edge columns: the filter assumes 0 beyond them."""
    edges = np.stack([images[:, :, :4], images[:, :, :-5:-1]], axis=-2, dtype=float)  # (M, n_v, 2, 4), outermost first
    noise = np.sqrt(np.mean(np.diff(edges, 3) ** 2) / 20)  # values and slopes cancel out in third differences
    largest, outermost = float(np.abs(images).max()), edges[..., :2].mean(axis=-1)
    for means in (outermost, outermost.mean(axis=1), outermost.mean(axis=(0, 1))):  # pixels, views, both edges
        edge_value = float(np.abs(means).max())
        noise_limit = _EDGE_DEVIATIONS * noise * np.sqrt(means.size / outermost.size / 2)
        if edge_value > max(_NEGLIGIBLE_EDGE * largest, noise_limit):
            share = f"{edge_value / largest:.0%} of their largest value"
            effect = "the object beyond the edge is missing, and values are wrong"
            return warn(f"{name}: the images fall only to {share} at their edge columns: {effect}", 4)


def filtered_backprojection(
    images: Array,
    views: Views,
    grid: Grid,
    window: str,
    weights: Callable[[int], Array | float],
    progress: Progress | None = None,
) -> Array:
    """Return the sum over views of the filtered images ``images[m] * weights(m)`` at the voxels, divided by depth^2.

    The rows are filtered with the ramp filter times `window` (see `ramp_matrix`). The volume is float32 (n_x, n_y, n_z).
    """
    n, (n_v, n_u) = len(images), views.shape
    matrices = views.projection_matrices()
    margin = _margin_columns(matrices, grid, n_u)
    matrix = ramp_matrix(n_u, window, margin)
    column, row, depth = np.moveaxis(matrices, 1, 0)
    # A border of zeros around the images lets them fall to 0 over one pixel beyond their edge.
    maps = np.stack([row + depth, column + (margin + 1) * depth, 0 * depth, depth, 0 * depth], axis=1) @ grid.affine
    view_bytes = 4 * n_v * (matrix.shape[1] + n_u)
    batch = int(np.clip(_BATCH_BYTES // view_bytes, 1, n))  # views that are held at once
    require(4 * grid.n_voxels + batch * view_bytes, f"a volume of {' x '.join(map(str, grid.shape))} voxels")
    volume = np.zeros(grid.shape, np.float32)
    padded = np.zeros((batch, n_v + 2, matrix.shape[1] + 2, 1), np.float32)
    filtered = padded[:, 1:-1, 1:-1, 0]
    planes = np.arange(grid.shape[2], dtype=np.float64)
    tell(progress, 0, n)
    for first in range(0, n, batch):
        end = min(first + batch, n)

        def filter_view(m: int, first: int = first) -> None:
            """Store the weighted image of view m with its rows filtered."""
            filtered[m - first] = (images[m] * weights(m)).astype(np.float32, copy=False) @ matrix

        run_all(filter_view, range(first, end), thread_count(None))
        views_now = padded[: end - first], maps[first:end]
        gather(volume, planes, *views_now, flat=True, by_depth=True, nearest=_NEAREST_DEPTH)
        tell(progress, end, n)
    return volume


def _margin_columns(matrices: Array, grid: Grid, n_u: int) -> int:
    """Return by how many columns, at most n_u, the voxels' images reach beyond the images' edges.

    Filtered images are not 0 beyond their edges, and only with these values do the values around an object cancel out.
    """
    column, _, depth = np.einsum("mij,pj->imp", matrices, np.insert(grid.corners(), 3, 1.0, axis=1))
    if (depth < 1e-3).any():
        return n_u
    column /= depth
    return int(np.clip(np.ceil(max(-column.min(), column.max() - (n_u - 1))), 0, n_u))


def angular_weights(angles: Array, turn: float) -> tuple[Array, float, float]:
    """Return the angular weights (M,) of views on a circle of circumference `turn`, the first angle, and the gap.

    A view's weight is half the angle to both of its neighbours; views at equal angles share one weight equally. If the
    largest gap is large, and far larger than the median gap, the views lie on an arc: the gap is the arc's opening, the
    first angle is the arc's beginning, and the views at both ends are weighted as if the median gap followed. Otherwise the
    gap is 0 and the first angle is the one after the largest gap.
    """
    order = np.argsort(angles % turn, kind="stable")
    angles = (angles % turn)[order]
    gaps = np.diff(angles, append=angles[0] + turn)  # from each angle to the next
    is_new = np.roll(gaps, 1) > _ANGLE_TOLERANCE * turn  # whether an angle differs from the angle before it
    group = np.cumsum(is_new) % is_new.sum()  # index of each angle's group of equal angles
    widest = int(gaps.argmax())
    gap, other_gaps = float(gaps[widest]), np.sort(np.delete(gaps, widest))
    median = float(other_gaps[np.searchsorted(other_gaps.cumsum(), other_gaps.sum() / 2)])  # weighted by the gaps
    if gap > max(_SMALL_GAP, _GAP_FACTOR * median):
        gaps[widest] = median
    else:
        gap = 0.0
    weights = np.empty(len(angles))
    weights[order] = (np.bincount(group, (gaps + np.roll(gaps, 1)) / 2) / np.bincount(group))[group]
    return weights, float(angles[(widest + 1) % len(angles)]), gap
