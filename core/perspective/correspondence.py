"""What all views have along the ray of one view's pixel, and the depth at which they agree best (a plane sweep).

Nothing is rectified: the planes of a `PerspectiveGrid` say where a pixel is in the world at each depth, and so in each view.

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

# Of an image's range: what varies less is of one value, stored as float32.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Where other views have what one view has at some pixels, by `find_correspondences`. NaN where nothing was found."""

    others: Indexes  # (V,), the views that were compared
    depths: Floats  # (…,), mm, at which they agree best with the pixels' view
    pixels: Floats  # (V, …, 2), column and row in each of the others at this depth
    scores: Floats  # (…,), the mean normalised cross-correlation there: 1 where they agree but for scale and offset
    curves: Floats  # (…, n_k), the scores at all planes
    views_compared: Indexes  # (…, n_k), in how many views the whole patch is in the image


def samples_along_rays(images: ArrayLike, grid: PerspectiveGrid, pixels: ArrayLike) -> Floats:
    """What every view has where `pixels` of the grid's view are at each of its planes: each camera's opinion of the depth.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Those of all views of the grid.
    grid : PerspectiveGrid
        Its view and planes: their depths are ``grid.depths``.
    pixels : array (…, 2)
        Column and row, in the grid's view; they need not be whole numbers.

    Returns
    -------
    array (…, M, n_k)
        Interpolated linearly between pixels; NaN outside an image, which ends half a pixel beyond the outermost pixels'
        centres, and behind a source. In the grid's own view the value is the same at all planes.
    """
    images, pixels = _checked(images, grid, pixels)
    n = pixels.size // 2 * grid.n_k
    require(8 * n * (2 * len(images) + 20), f"samples along {pixels.size // 2} rays at {grid.n_k} planes")
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
    """The depths at which other views look most like the surroundings of `pixels`, and where these are in the others.

    At each plane of the grid, the square of pixels around each of `pixels` is taken to lie in that plane. Where the other
    views have it, their values are correlated with it (normalised, so that neither scale nor offset counts), and the mean
    over the views that have the whole square is the plane's score. The highest score decides, with a parabola through it
    and its neighbours.

    Images of emission and transmission are sums along rays, so what lies one behind the other is mixed in them. The search
    finds small sources and edges; a filled volume has no one depth to be found.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Those of all views of the grid.
    grid : PerspectiveGrid
        The view of `pixels`, and the planes to look at.
    pixels : array (…, 2)
        Column and row, in the grid's view.
    others : int or array of int (V,)
        The views to compare with; default: all others.
    half_width : int
        The squares have 2 `half_width` + 1 pixels along columns and rows.
    progress
        Called as ``progress(done, total)`` after each pixel; what it raises stops the work.

    Returns
    -------
    Correspondences
        NaN where no plane has a score: the square is not in the image, is of one value, or no other view has it.

    Raises
    ------
    InputError
        There are no other views, or the grid's own is among them.
    """
    images, pixels = _checked(images, grid, pixels)
    half_width = whole_number(half_width, "half width")
    chosen = np.delete(np.arange(len(images)), grid.m)
    if others is not None:
        chosen = np.atleast_1d(view_indices(grid.views, others, "others")) if np.size(others) else chosen[:0]
    if not len(chosen) or grid.m in chosen:
        raise InputError(f"correspondences: expected one or more views besides {grid.m}, got {chosen.tolist()}")
    flat = pixels.reshape(-1, 2)
    curves, counts = np.full((len(flat), grid.n_k), np.nan), np.zeros((len(flat), grid.n_k), np.intp)
    for i, pixel in enumerate(flat):
        curves[i], counts[i] = _scores(images, grid, pixel, chosen, half_width)
        tell(progress, i + 1, len(flat))
    depths, scores = _highest(curves, grid)
    starts, per_depth = rays_by_depth(grid.views, grid.m, flat)
    points = starts + depths[:, None] * per_depth
    places = np.stack([pixels_of(matrix, points) for matrix in grid.views[chosen].projection_matrices()])
    shape, at_planes = pixels.shape[:-1], (*pixels.shape[:-1], grid.n_k)
    places, depths, scores = places.reshape(len(chosen), *shape, 2), depths.reshape(shape), scores.reshape(shape)
    return Correspondences(chosen, depths, places, scores, curves.reshape(at_planes), counts.reshape(at_planes))


def _scores(
    images: Floats, grid: PerspectiveGrid, pixel: Floats, others: Indexes, half_width: int
) -> tuple[Floats, Indexes]:
    """Scores of one pixel at all planes, and how many views each is of: (n_k,) each."""
    around = np.arange(-half_width, half_width + 1, dtype=np.float64)
    square = pixel + np.stack(np.meshgrid(around, around), axis=-1).reshape(-1, 2)
    wanted, shape = _normalised(_interpolated(images[grid.m], square)[:, None], images[grid.m])
    total, count = np.zeros(grid.n_k), np.zeros(grid.n_k, np.intp)
    if not shape.all():
        return np.full(grid.n_k, np.nan), count
    points = _points(grid, square)
    for m, matrix in zip(others, grid.views[others].projection_matrices(), strict=True):
        values = _interpolated(images[m], pixels_of(matrix, points))
        seen = np.isfinite(values).all(axis=0)
        # Where a view has nothing but one value, it does not have what is looked for: 0.
        total[seen] += (wanted * _normalised(values[:, seen], images[m])[0]).sum(axis=0)
        count += seen
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), count


def _normalised(values: Floats, image: Floats) -> tuple[Floats, Bools]:
    """Columns less their mean, of length 1, and which can be so: those that vary by more than rounding; others are 0."""
    away = values - values.mean(axis=0)
    length = np.linalg.norm(away, axis=0)
    varied = length > _ROUNDING * np.ptp(image)
    return np.where(varied, away, 0.0) / np.where(varied, length, 1.0), varied


def _highest(curves: Floats, grid: PerspectiveGrid) -> tuple[Floats, Floats]:
    """Depths, mm, and scores where curves (N, n_k) are highest, by a parabola through three planes; NaN for no score."""
    found = np.isfinite(curves).any(axis=1)
    best = np.where(np.isfinite(curves), curves, -np.inf).argmax(axis=1)
    padded = np.pad(curves, ((0, 0), (1, 1)), constant_values=np.nan)
    before, at, after = (padded[np.arange(len(curves)), best + i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = (before - after) / (2 * (before - 2 * at + after))
    offset = np.where(np.isfinite(offset), offset, 0.0).clip(-0.5, 0.5)
    scores = np.where(np.isfinite(before + after), at - (before - after) * offset / 4, at)
    by_depth = grid.views.parallel or grid.uniform == "depth"  # else planes are evenly spaced in 1 / depth
    even = grid.depths if by_depth else 1 / grid.depths
    place = even[best] + offset * (even[-1] - even[0]) / max(grid.n_k - 1, 1)
    depths = place if by_depth else 1 / place
    return np.where(found, depths, np.nan), np.where(found, scores, np.nan)


def _points(grid: PerspectiveGrid, pixels: Floats) -> Floats:
    """World points (…, n_k, 3) of pixels (…, 2) at the grid's planes."""
    return points_at_depths(grid.views, grid.m, pixels[..., None, :], grid.depths)


def _interpolated(image: Floats, pixels: Floats) -> Floats:
    """An image's values (…) at pixels (…, 2), linear between their centres; NaN outside."""
    ends = np.array(image.shape[::-1], dtype=np.float64) - 1
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels <= ends + 0.5)).all(axis=-1)
    at = np.where(inside[..., None], pixels, 0.0).clip(0, ends)
    first = np.minimum(at, np.maximum(ends - 1, 0)).astype(np.intp)
    second = np.minimum(first + 1, ends.astype(np.intp))
    (x, y), (i, j), (after_i, after_j) = (np.moveaxis(each, -1, 0) for each in (at - first, first, second))
    upper = image[j, i] * (1 - x) + image[j, after_i] * x
    lower = image[after_j, i] * (1 - x) + image[after_j, after_i] * x
    return np.where(inside, upper * (1 - y) + lower * y, np.nan)


def _checked(images: ArrayLike, grid: PerspectiveGrid, pixels: ArrayLike) -> tuple[Floats, Floats]:
    """Images of all views of a grid, and pixels (…, 2)."""
    instance(grid, PerspectiveGrid, "perspective grid")
    images = real_array(images, "images", (len(grid.views), *grid.views.shape))
    return images, real_array(pixels, "pixels", (2,), batch=True)
