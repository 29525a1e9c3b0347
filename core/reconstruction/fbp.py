"""Filtered backprojection of parallel views."""

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
        Parallel ones, whose directions lie in a plane: half a circle or more, at any angles. Each view counts for the angle
        halfway to its neighbours, so that they may be unevenly spaced; those at equal angles share what one counts for.
    grid : Grid
        Where the volume is computed; any part of the object.
    window : str
        What the ramp filter is multiplied with: "ramp" (nothing: sharpest), "shepp-logan", "cosine", "hamming" or "hann"
        (least noise).
    progress
        Called as ``progress(views done, views)``; what it raises stops the work.
    quantity : str, optional
        What the volume is of (see `Volume`); by default that of the volume whose images a projector made, else "mu".

    Returns
    -------
    Volume
        Negative values, which noise and edges make, are left in.

    Raises
    ------
    InputError
        Views that are not parallel or do not turn in a plane, images of another shape or not finite, no such window.

    Warns
    -----
    InputWarning
        Directions are missing: edges along them are lost. Or the images do not fall to about 0 at their edge columns:
        the object is wider, or the detector displaced, and values are wrong.

    References
    ----------
    A. C. Kak, M. Slaney, "Principles of Computerized Tomographic Imaging", IEEE Press (1988), chapter 3.
    """
    images, quantity = checked_images(images, quantity, views, grid, "fbp")
    if not views.parallel:
        raise InputError("fbp: expected parallel views (see parallel_views); views from sources are for fdk")
    along = views.detector_centers - views.sources
    along = along / np.linalg.norm(along, axis=1)[:, None]
    axis, second, first = np.linalg.eigh(along.T @ along)[1].T  # across the plane in which they lie best, and in it
    out_of_plane = np.abs(along @ axis)
    if out_of_plane.max() > _IN_PLANE:
        raise InputError(
            f"fbp: view {int(out_of_plane.argmax())}: its rays do not lie in the plane in which the others turn; use sirt"
        )
    images, views = rows_across(images, views, axis, "fbp")
    shares, _, gap = angular_weights(np.arctan2(along @ second, along @ first), np.pi)
    if gap:
        empty = f"{np.degrees(gap):.0f} degrees of the half circle have no view"
        warn(f"fbp: {empty}: edges along their directions are lost", 2)
    # The pixels' distance as the rays see it, across their direction.
    pitch = np.abs(np.einsum("mi,mi->m", views.u_steps, np.cross(axis, along)))
    weights = shares / pitch
    return Volume(filtered_backprojection(images, views, grid, window, lambda m: weights[m], progress), grid, quantity)
