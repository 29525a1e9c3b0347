"""Each camera predicts the others: what one view's image and its opinion of depth say that other views should see."""

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

_NEAREST = 1e-3  # of the farthest depth: closer to a source, nothing is predicted


def spread_along_rays(image: ArrayOrTensor, distribution: ArrayOrTensor, g: PerspectiveGrid) -> ArrayOrTensor:
    """One view's image, shared out among the cells along its rays: ``g.image`` of the result is `image` again.

    Parameters
    ----------
    image : array or tensor (…, n_v, n_u)
        Line integrals, value x mm.
    distribution : array or tensor (…, n_u, n_v, n_k)
        Which share of a pixel's line integral comes from each cell along its ray: numbers of at least 0, which are divided
        by their sum along the ray. Of a volume in the view's coordinates, `to_perspective`, it is the array times
        ``g.ray_lengths()``.
    g : PerspectiveGrid
        The view's.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Values that keep density, as ``to_perspective`` makes them: image times share by the ray's length in the cell. A
        tensor's gradient follows, in both arguments.

    Raises
    ------
    InputError
        Shares below 0, or only 0 along a ray whose pixel is not 0.
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
    array: ArrayOrTensor,
    g: PerspectiveGrid,
    views: Views,
    planes: int | None = None,
    progress: Progress | None = None,
) -> tuple[ArrayOrTensor, ArrayOrTensor]:
    """The images that views should see of what is given in the coordinates of one.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
        Values that keep density, as `to_perspective` and `spread_along_rays` make them.
    g : PerspectiveGrid
        The array's.
    views : Views
        Whose images are predicted; `g`'s own may be among them.
    planes : int, optional
        Planes of the perspective grids in which the views' images are summed; they reach over the depths of all of `g`.
        None: as many as `g` has cells along its longest axis.
    progress
        Called as ``progress(views done, views)``; what it raises stops the work.

    Returns
    -------
    images : array or tensor (…, M, n_v, n_u)
        Line integrals, value x mm: means over the pixels' areas. A tensor's gradient follows.
    covered : array or tensor (M, n_v, n_u) of bool
        The pixels whose rays meet the cells of `g`. Beyond these cells nothing is known: what a view sees outside of them is
        missing in its prediction.

    Raises
    ------
    InputError
        More memory is needed than there is.

    Notes
    -----
    The values are interpolated between the cells' places, twice as densely at least as these are, but at no more than 8
    points along each axis of a new cell. With pixels or planes that cover more than 4 cells, details between are missed.
    Interpolation smooths the values by about a cell, and so the images.
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
            h = PerspectiveGrid(views, n, n_k, near if views.parallel else max(near, _NEAREST * far), far, "depth")
            images.append(h.image(camera_to_camera(array, g, h)))
            covered.append(_meet(g, h))
        else:  # all of it is behind the source
            images.append(zeros((*array.shape[:-3], *views.shape), array))
            covered.append(np.zeros(views.shape, bool))
        tell(progress, n + 1, len(views))
    if is_tensor(array):
        import torch

        return torch.stack(images, -3), torch.from_numpy(np.stack(covered)).to(array.device)
    return np.stack(images, -3), np.stack(covered)


def prediction_errors(images: ArrayOrTensor, predicted: ArrayOrTensor, covered: ArrayOrTensor) -> ArrayOrTensor:
    """What views saw less what was predicted, where that says something, else 0.

    Parameters
    ----------
    images : array or tensor (…, M, n_v, n_u)
        What the views saw: line integrals, value x mm.
    predicted, covered : arrays or tensors
        What `predict_views` returned for the same views.

    Returns
    -------
    array or tensor (…, M, n_v, n_u)
        A tensor's gradient follows.
    """
    images, predicted = promote(images, predicted)
    shape = tuple(predicted.shape[-3:])
    if tuple(images.shape[-3:]) != shape or tuple(covered.shape) != shape:
        shapes = ", ".join(shape_text(tuple(each.shape)) for each in (images, predicted, covered))
        expected = "images, predictions and pixels covered of one shape"
        raise InputError(f"prediction errors: expected {expected}, got {shapes}")
    differences: Any = images - predicted
    return differences * cast_like(covered, differences)


def _meet(g: PerspectiveGrid, h: PerspectiveGrid) -> Any:
    """Which pixels (n_v, n_u) of `h` have cells whose places lie in `g`."""
    nothing, seen = np.zeros(h.shape, np.float32), np.zeros(h.shape, np.int32)
    zero, matrix = np.zeros((1, *g.shape), np.float32), g.index_matrix @ h.inverse
    gather(nothing, h.planes_at(np.arange(h.n_k)), zero, matrix[None], seen=seen)
    return seen.any(axis=2).T


def _require_shares(image: ArrayOrTensor, distribution: ArrayOrTensor) -> None:
    plain = distribution.detach() if is_tensor(distribution) else distribution
    if plain.min() < 0:
        raise InputError(f"depth distribution: expected shares of 0 or more, got {float(plain.min()):g}")
    lost = (plain.sum(-1) == 0) & (image.swapaxes(-1, -2) != 0)
    if lost.any():
        index = np.argwhere(lost.cpu().numpy() if is_tensor(lost) else lost)[0]
        ray = f"the ray of column {index[-2]}, row {index[-1]}"
        raise InputError(f"depth distribution: it is 0 all along {ray}, whose pixel is not 0")
