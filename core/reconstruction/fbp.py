"""Filtered backprojection of parallel views: FBP."""

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..progress import Progress
from ..volumes.volume import Volume
from .filtered import angular_weights, checked_images, filtered_backprojection, rows_across

_IN_PLANE = np.sin(np.radians(1.0))


def fbp(
    images: ArrayLike,
    views: Views,
    grid: Grid,
    window: str = "ramp",
    progress: Progress | None = None,
    *,
    quantity: str | None = None,
) -> Volume:
    """Reconstruct the volume whose line integrals are `images` by filtered backprojection of parallel views.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Line integrals, value x mm, such as those of ``Projector(grid, views)``.
    views : Views
        Parallel views whose directions lie in a plane and cover half a circle or more, in any order. They may be unevenly
        spaced: a view's weight is half the angle to both of its neighbours; views at equal angles share one weight.
    grid : Grid
        Grid of the volume, which may cover any part of the object.
    window : str
        Window that multiplies the ramp filter: "ramp" (no window, sharpest), "shepp-logan", "cosine", "hamming" or "hann"
        (least noise).
    progress
        Called as ``progress(views done, views)``; an exception that it raises stops the reconstruction.
    quantity : str, optional
        Quantity of the volume (see `Volume`); by default that of the volume whose images a projector made, else "mu".

    Returns
    -------
    Volume
        The reconstructed volume. Negative values, which noise and edges cause, are kept.

    Raises
    ------
    InputError
        The views are not parallel or do not turn in a plane, the images have another shape or are not finite, or there is no
        window of this name.

    Warns
    -----
    InputWarning
        Directions are missing, so that edges along them are lost; or the images do not fall to about 0 at their edge
        columns, because the object is wider or the detector displaced, and values are wrong.

    References
    ----------
    A. C. Kak, M. Slaney, "Principles of Computerized Tomographic Imaging", IEEE Press (1988), chapter 3.
    """
    images, quantity = checked_images(images, quantity, views, grid, "fbp")
    if not views.parallel:
        raise InputError("fbp: expected parallel views (see parallel_views); views from sources are for fdk")
    directions = views.detector_centers - views.sources
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    axis, second, first = np.linalg.eigh(directions.T @ directions)[1].T  # normal and basis of the best-fitting plane
    out_of_plane = np.abs(directions @ axis)
    if out_of_plane.max() > _IN_PLANE:
        raise InputError(
            f"fbp: view {int(out_of_plane.argmax())}: its rays do not lie in the plane in which the views turn; use sirt"
        )
    images, views = rows_across(images, views, axis, "fbp")
    view_angles, _, gap = angular_weights(np.arctan2(directions @ second, directions @ first), np.pi)
    if gap:
        missing = f"{np.degrees(gap):.0f} degrees of the half circle have no view"
        warn(f"fbp: {missing}: edges along their directions are lost", 2)
    # The pitch is measured across the rays: it is the distance between the rays of neighbouring pixels.
    pitch = np.abs(np.einsum("mi,mi->m", views.u_steps, np.cross(axis, directions)))
    weights = view_angles / pitch
    return Volume(filtered_backprojection(images, views, grid, window, lambda m: weights[m], progress), grid, quantity)
