"""Prediction of one view's image from another's, with a distribution of its pixel values over depth."""

from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, cast_like, checked, is_tensor, namespace, promote, zeros
from ..errors import InputError
from ..geometry.views import Views
from ..progress import Progress, tell
from ..validation import instance, shape_text, whole_number
from .perspective_grid import PerspectiveGrid, depths_in_views
from .places import gather
from .resampling import camera_to_camera

_NEAREST = 1e-3  # share of the farthest depth; closer to a source, nothing is predicted


def spread_along_rays(image: ArrayOrTensor, distribution: ArrayOrTensor, g: PerspectiveGrid) -> ArrayOrTensor:
    """Share out one view's image among the cells along its rays, such that ``g.image`` of the result is `image` again.

    Parameters
    ----------
    image : array or tensor (…, n_v, n_u)
        Line integrals, value x mm.
    distribution : array or tensor (…, n_u, n_v, n_k)
        Share of a pixel's line integral that comes from each cell along its ray: values of at least 0, which are divided
        by their sum along the ray. For a volume in the view's coordinates, `to_perspective`, it is the array times
        ``g.ray_lengths()``.
    g : PerspectiveGrid
        The view's cells.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Mean values of the cells, as ``to_perspective`` returns them: image times share, divided by the ray's length in the
        cell. A tensor's gradient follows, in both arguments.

    Raises
    ------
    InputError
        There are shares below 0, or only zeros along a ray whose pixel is not 0.
    """
    instance(g, PerspectiveGrid, "spread_along_rays")
    image = checked(image, "image", g.shape[1::-1], False, batch=True)
    distribution = checked(distribution, "depth distribution", g.shape, False, batch=True)
    image, distribution = promote(image, distribution)
    _require_shares(image, distribution)
    total = distribution.sum(-1)
    total = namespace(total).where(total > 0, total, namespace(total).ones_like(total))
    per_share: Any = image.swapaxes(-1, -2) / total
    return per_share[..., None] * distribution / cast_like(g.ray_lengths(), distribution)


def predict_views(
    array: ArrayOrTensor, g: PerspectiveGrid, views: Views, planes: int | None = None, progress: Progress | None = None
) -> tuple[ArrayOrTensor, ArrayOrTensor]:
    """Predict the images of other views from values in the coordinates of one view.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
        Mean values of cells, as `to_perspective` and `spread_along_rays` return them.
    g : PerspectiveGrid
        The cells of the array.
    views : Views
        Views whose images are predicted; the view of `g` may be among them.
    planes : int, optional
        Number of planes of the perspective grids in which the views' images are summed; the grids extend over all depths of
        `g`. None: as many as `g` has cells along its longest axis.
    progress
        Called as ``progress(views done, views)``; an exception raised there stops the work.

    Returns
    -------
    images : array or tensor (…, M, n_v, n_u)
        Line integrals, value x mm: means over the pixels' areas. A tensor's gradient follows.
    covered : array or tensor (M, n_v, n_u) of bool
        Pixels whose rays meet the cells of `g`. Values outside these cells are unknown, and are missing in the predictions.

    Raises
    ------
    InputError
        More memory is needed than there is.

    Notes
    -----
    The values are interpolated linearly between the cells' places at two or more points per cell, but at no more than
    8 points along each axis of a new cell. With pixels or planes that cover more than 4 cells, details between the points
    are missed. Interpolation smooths the values, and so the images, by about a cell.
    """
    instance(g, PerspectiveGrid, "predict_views")
    instance(views, Views, "predict_views")
    if not len(views):
        raise InputError("predict_views: expected one or more views, got none")
    array = checked(array, "perspective array", g.shape, False, batch=True)
    n_k = max(g.shape) if planes is None else whole_number(planes, "planes")
    n_u, n_v, _ = g.shape
    ends = np.array([[-0.5, n_u - 0.5], [-0.5, n_v - 0.5], g.edges[[0, -1]]])
    corners = g.to_world(np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3))
    images, covered = [], []
    for n, depths in enumerate(depths_in_views(views, corners)):
        near, far = float(depths.min()), float(depths.max())
        if views.parallel or far > 0:
            g_n = PerspectiveGrid(views, n, n_k, near if views.parallel else max(near, _NEAREST * far), far, "depth")
            images.append(g_n.image(camera_to_camera(array, g, g_n)))
            covered.append(_covered_pixels(g, g_n))
        else:  # all cells are behind the source
            images.append(zeros((*array.shape[:-3], *views.shape), array))
            covered.append(np.zeros(views.shape, bool))
        tell(progress, n + 1, len(views))
    if is_tensor(array):
        import torch

        return torch.stack(images, -3), torch.from_numpy(np.stack(covered)).to(array.device)
    return np.stack(images, -3), np.stack(covered)


def prediction_errors(images: ArrayOrTensor, predicted: ArrayOrTensor, covered: ArrayOrTensor) -> ArrayOrTensor:
    """Return measured minus predicted images; 0 where the prediction does not cover a pixel.

    Parameters
    ----------
    images : array or tensor (…, M, n_v, n_u)
        Measured line integrals, value x mm.
    predicted, covered : arrays or tensors
        Results of `predict_views` for the same views.

    Returns
    -------
    array or tensor (…, M, n_v, n_u)
        A tensor's gradient follows.
    """
    images, predicted = promote(images, predicted)
    shape = tuple(predicted.shape[-3:])
    if tuple(images.shape[-3:]) != shape or tuple(covered.shape) != shape:
        shapes = ", ".join(shape_text(tuple(array.shape)) for array in (images, predicted, covered))
        expected = "images, predictions and pixels covered of one shape"
        raise InputError(f"prediction errors: expected {expected}, got {shapes}")
    differences: Any = images - predicted
    return differences * cast_like(covered, differences)


def _covered_pixels(source: PerspectiveGrid, target: PerspectiveGrid) -> Any:
    """Return whether each pixel (n_v, n_u) of `target` has a cell whose place lies within `source`."""
    points, n_covering = np.zeros(target.shape, np.float32), np.zeros(target.shape, np.int32)
    array, matrix = np.zeros((1, *source.shape), np.float32), source.index_matrix @ target.inverse
    gather(points, target.planes_at(np.arange(target.n_k)), array, matrix[None], seen=n_covering)
    return n_covering.any(axis=2).T


def _require_shares(image: ArrayOrTensor, distribution: ArrayOrTensor) -> None:
    """Raise `InputError` for shares (…, n_u, n_v, n_k) below 0, or all 0 along a ray whose pixel of `image` is not 0."""
    shares = distribution.detach() if is_tensor(distribution) else distribution
    if shares.min() < 0:
        raise InputError(f"depth distribution: expected shares of 0 or more, got {float(shares.min()):g}")
    lacking = (shares.sum(-1) == 0) & (image.swapaxes(-1, -2) != 0)
    if lacking.any():
        index = np.argwhere(lacking.cpu().numpy() if is_tensor(lacking) else lacking)[0]
        ray = f"the ray of column {index[-2]}, row {index[-1]}"
        raise InputError(f"depth distribution: it is 0 all along {ray}, whose pixel is not 0")
