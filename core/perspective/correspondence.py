"""Plane sweep: the values of all views along the ray of one view's pixel, and the depth at which the views agree best.

Images are not rectified: a `PerspectiveGrid` gives the world point of a pixel at each depth, and so its pixel in each view.

References
----------
R. T. Collins, "A space-sweep approach to true multi-image matching", Proc. IEEE CVPR (1996) 358-363.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import ArrayLike, Bools, Floats, Indexes
from ..errors import InputError
from ..memory import require
from ..progress import Progress, tell
from ..validation import instance, real_array, whole_number
from .perspective_grid import PerspectiveGrid
from .view_rays import Indices, pixels_of, points_at_depths, rays_by_depth, view_indices

# Share of an image's range: a patch that varies less is uniform, up to the rounding of float32.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Matches of one view's pixels in other views, by `find_correspondences`; NaN where there is none."""

    others: Indexes  # (V,), indices of the views that were compared
    depths: Floats  # (…,), mm, depth in the pixels' view at which the other views agree best
    pixels: Floats  # (V, …, 2), column and row in each of the other views at this depth
    scores: Floats  # (…,), mean normalised cross-correlation there: 1 for equality up to scale and offset
    curves: Floats  # (…, n_k), scores at all planes
    views_compared: Indexes  # (…, n_k), number of views whose image contains the whole patch


def samples_along_rays(images: ArrayLike, grid: PerspectiveGrid, pixels: ArrayLike) -> Floats:
    """Return the values of every view along the rays of `pixels` of the grid's view, one value for each of its planes.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Images of all views of the grid.
    grid : PerspectiveGrid
        View and planes; the depths of the planes are ``grid.depths``.
    pixels : array (…, 2)
        Column and row in the grid's view; they need not be whole numbers.

    Returns
    -------
    array (…, M, n_k)
        Values interpolated linearly between pixels; NaN outside an image, which ends half a pixel beyond the outermost
        pixels' centres, and behind a source. In the grid's own view the value is the same at all planes.
    """
    images, pixels = _checked(images, grid, pixels)
    n_samples = pixels.size // 2 * grid.n_k
    require(8 * n_samples * (2 * len(images) + 20), f"samples along {pixels.size // 2} rays at {grid.n_k} planes")
    points = _points(grid, pixels).reshape(-1, 3)
    matrices = grid.views.projection_matrices()
    values = [_interpolated(image, pixels_of(matrix, points)) for image, matrix in zip(images, matrices, strict=True)]
    return np.moveaxis(np.reshape(values, (len(images), *pixels.shape[:-1], grid.n_k)), 0, -2)


def find_correspondences(
    images: ArrayLike,
    grid: PerspectiveGrid,
    pixels: ArrayLike,
    others: Indices | None = None,
    half_width: int = 3,
    progress: Progress | None = None,
) -> Correspondences:
    """Find the depths at which other views look most like the surroundings of `pixels`, and their pixels in the other views.

    At each plane of the grid, the square of pixels around each of `pixels` is assumed to lie in that plane. Its values are
    correlated with those of every other view whose image contains the whole square (normalised, so that neither scale nor
    offset matters); the mean over these views is the plane's score. The best depth is at the vertex of a parabola through
    the highest score and its neighbours.

    Images of emission and transmission are sums along rays, so objects one behind the other overlap in them. The search
    finds small sources and edges; a filled volume has no single depth.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Images of all views of the grid.
    grid : PerspectiveGrid
        The view of `pixels`, and the planes to search.
    pixels : array (…, 2)
        Column and row in the grid's view.
    others : int or array of int (V,)
        Indices of the views to compare with; by default all other views.
    half_width : int
        The squares have 2 `half_width` + 1 pixels along columns and rows.
    progress
        Called as ``progress(done, total)`` after each pixel; an exception raised there stops the work.

    Returns
    -------
    Correspondences
        NaN where no plane has a score: the square is not in the image, is uniform, or is in no other view.

    Raises
    ------
    InputError
        There are no other views, or the grid's own view is among them.
    """
    images, pixels = _checked(images, grid, pixels)
    half_width = whole_number(half_width, "half width")
    chosen = np.delete(np.arange(len(images)), grid.m)
    if others is not None:
        chosen = np.atleast_1d(view_indices(grid.views, others, "others")) if np.size(others) else chosen[:0]
    if not len(chosen) or grid.m in chosen:
        raise InputError(f"correspondences: expected one or more views besides {grid.m}, got {chosen.tolist()}")
    flat = pixels.reshape(-1, 2)
    curves, n_views = np.full((len(flat), grid.n_k), np.nan), np.zeros((len(flat), grid.n_k), np.intp)
    for i, pixel in enumerate(flat):
        curves[i], n_views[i] = _scores(images, grid, pixel, chosen, half_width)
        tell(progress, i + 1, len(flat))
    depths, scores = _highest(curves, grid)
    starts, per_depth = rays_by_depth(grid.views, grid.m, flat)
    points = starts + depths[:, None] * per_depth
    matches = np.stack([pixels_of(matrix, points) for matrix in grid.views[chosen].projection_matrices()])
    shape, full_shape = pixels.shape[:-1], (*pixels.shape[:-1], grid.n_k)
    matches, depths, scores = matches.reshape(len(chosen), *shape, 2), depths.reshape(shape), scores.reshape(shape)
    return Correspondences(chosen, depths, matches, scores, curves.reshape(full_shape), n_views.reshape(full_shape))


def _scores(
    images: Floats, grid: PerspectiveGrid, pixel: Floats, other_views: Indexes, half_width: int
) -> tuple[Floats, Indexes]:
    """Return the scores of one pixel at all planes, and the number of views in each score: (n_k,) each."""
    offsets = np.arange(-half_width, half_width + 1, dtype=np.float64)
    square = pixel + np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    template, is_varied = _normalised(_interpolated(images[grid.m], square)[:, None], images[grid.m])
    total, n_views = np.zeros(grid.n_k), np.zeros(grid.n_k, np.intp)
    if not is_varied.all():
        return np.full(grid.n_k, np.nan), n_views
    points = _points(grid, square)
    for m, matrix in zip(other_views, grid.views[other_views].projection_matrices(), strict=True):
        values = _interpolated(images[m], pixels_of(matrix, points))
        inside = np.isfinite(values).all(axis=0)
        # A uniform patch does not resemble the template: its correlation is 0.
        total[inside] += (template * _normalised(values[:, inside], images[m])[0]).sum(axis=0)
        n_views += inside
    return np.where(n_views > 0, total / np.maximum(n_views, 1), np.nan), n_views


def _normalised(values: Floats, image: Floats) -> tuple[Floats, Bools]:
    """Return columns minus their mean, scaled to length 1, and whether each varies by more than rounding; others are 0."""
    centred = values - values.mean(axis=0)
    norm = np.linalg.norm(centred, axis=0)
    varied = norm > _ROUNDING * np.ptp(image)
    return np.where(varied, centred, 0.0) / np.where(varied, norm, 1.0), varied


def _highest(curves: Floats, grid: PerspectiveGrid) -> tuple[Floats, Floats]:
    """Return depths, mm, and scores at the maxima of curves (N, n_k); NaN for a curve without scores.

    The maximum is at the vertex of the parabola through the highest score and its two neighbours.
    """
    has_score = np.isfinite(curves).any(axis=1)
    best = np.where(np.isfinite(curves), curves, -np.inf).argmax(axis=1)
    padded = np.pad(curves, ((0, 0), (1, 1)), constant_values=np.nan)
    lower, peak, upper = (padded[np.arange(len(curves)), best + i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (lower - upper) / (2 * (lower - 2 * peak + upper))
    offset = np.where(np.isfinite(offset), offset, 0.0).clip(-0.5, 0.5)
    scores = np.where(np.isfinite(lower + upper), peak - (lower - upper) * offset / 4, peak)
    is_even_in_depth = grid.views.parallel or grid.uniform == "depth"  # else in 1 / depth
    sweep = grid.depths if is_even_in_depth else 1 / grid.depths
    position = sweep[best] + offset * (sweep[-1] - sweep[0]) / max(grid.n_k - 1, 1)
    depths = position if is_even_in_depth else 1 / position
    return np.where(has_score, depths, np.nan), np.where(has_score, scores, np.nan)


def _points(grid: PerspectiveGrid, pixels: Floats) -> Floats:
    """Return the world points (…, n_k, 3), mm, of pixels (…, 2) at the grid's planes."""
    return points_at_depths(grid.views, grid.m, pixels[..., None, :], grid.depths)


def _interpolated(image: Floats, pixels: Floats) -> Floats:
    """Return an image's values (…) at pixels (…, 2), linear between the pixels' centres; NaN outside the image."""
    ends = np.array(image.shape[::-1], dtype=np.float64) - 1
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels <= ends + 0.5)).all(axis=-1)
    clipped = np.where(inside[..., None], pixels, 0.0).clip(0, ends)
    first = np.minimum(clipped, np.maximum(ends - 1, 0)).astype(np.intp)
    second = np.minimum(first + 1, ends.astype(np.intp))
    (x, y), (i, j), (next_i, next_j) = (np.moveaxis(array, -1, 0) for array in (clipped - first, first, second))
    upper = image[j, i] * (1 - x) + image[j, next_i] * x
    lower = image[next_j, i] * (1 - x) + image[next_j, next_i] * x
    return np.where(inside, upper * (1 - y) + lower * y, np.nan)


def _checked(images: ArrayLike, grid: PerspectiveGrid, pixels: ArrayLike) -> tuple[Floats, Floats]:
    """Return images (M, n_v, n_u) of a grid's views and pixels (…, 2) as arrays; raise `InputError` for other shapes."""
    instance(grid, PerspectiveGrid, "perspective grid")
    images = real_array(images, "images", (len(grid.views), *grid.views.shape))
    return images, real_array(pixels, "pixels", (2,), batch=True)
