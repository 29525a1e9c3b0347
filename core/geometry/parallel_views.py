"""Views with parallel rays, whose sources are at infinity, as in a parallel-beam tomograph."""

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..validation import lengths, one_for_all, radians, real_array, whole_shape
from .frames import module_frames
from .views import Views


def parallel_views(
    angles: ArrayLike,
    shape: tuple[int, int],
    pitch: ArrayLike,
    elevation: ArrayLike = 0.0,
    center: ArrayLike = (0.0, 0.0, 0.0),
) -> Views:
    """Return parallel views from sources at infinity around the z axis.

    They are the limit of `PinholeSystem.views` for modules that are ever farther away: the source of angle phi and elevation
    theta lies in the direction ``(cos theta cos phi, cos theta sin phi, sin theta)``, the rays run the other way, and images
    have the u and v of `module_frames`. At elevation 0, columns go along ``u = (sin phi, -cos phi, 0)`` and rows along +z.

    Parameters
    ----------
    angles : array (M,)
        Azimuths phi of the sources around z, from x towards y, rad.
    shape
        Numbers of pixels (n_v, n_u) of each image.
    pitch
        Pitch of the pixels, mm: one number, or (pitch_u, pitch_v).
    elevation : float or array (M,)
        Elevations theta of the sources over the plane z = 0, rad, from -pi/2 to pi/2.
    center
        World point (3,), mm, in the middle of all images.

    Returns
    -------
    Views
        Parallel views. Their detectors, and the points from which `Views.rays` begins in place of the sources, are 1 m plus
        four image diagonals from `center`. A projector's rays are whole lines.

    Raises
    ------
    InputError
        If there are no angles, or an argument has another shape or is out of its range.

    Examples
    --------
    >>> views = parallel_views(np.arange(180) * np.pi / 180, (128, 128), 1.0)
    >>> images = Projector(grid, views)(volume)
    """
    if not len(angles := radians(angles, "angles", (None,))):
        raise InputError("angles: expected one or more, got none")
    shape = whole_shape(shape, "image shape", 2)
    pitch_u, pitch_v = lengths(pitch, "pixel pitch", 2)
    elevation = one_for_all(elevation, "elevation", len(angles))
    if np.abs(elevation).max() > np.pi / 2 + 1e-12:
        raise InputError(f"elevation: expected from -pi/2 to pi/2 rad, got {elevation[np.abs(elevation).argmax()]:g}")
    center = real_array(center, "center", (3,))
    cosine = np.cos(elevation)
    directions = np.stack([cosine * np.cos(angles), cosine * np.sin(angles), np.sin(elevation)], axis=1)
    u, v, k = module_frames(directions).transpose(1, 0, 2)
    distance = 1000.0 + 4.0 * float(np.hypot(shape[0] * pitch_v, shape[1] * pitch_u))
    return Views(center - distance * k, center + distance * k, pitch_u * u, pitch_v * v, shape, parallel=True)
