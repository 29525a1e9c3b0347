"""Two ways to set up a system's radiographs: the true geometry, and that of the scripts written for DiffDRR before.

They differ in more than scale. The true one looks from the pinhole, so that near things are large: magnified by
``magnification * l / h`` at distance h from the pinhole. In the other one every source is ``5 l`` from the isocentre,
which is not where its pinhole is (b). It gives plausible radiographs, but not what the scanner sees, and its pixels
are no places on a crystal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..validation import positive, real_array, whole_shape
from .system import PinholeSystem
from .views import Views


def pinhole_views(
    system: PinholeSystem,
    shape: tuple[int, int] = (256, 256),
    pitch: ArrayLike | None = None,
    magnification: float = 10.0,
) -> Views:
    """The true geometry: each source is its module's pinhole, the detector the virtual one (``system.views``).

    Parameters
    ----------
    system
    shape
        Pixels (n_v, n_u).
    pitch
        Pixel size, mm, on the virtual detector, one number or (pitch_u, pitch_v). Default: the image is the crystal's.
    magnification
        Distance of the virtual detector from the pinhole, in units of l.
    """
    return system.views(shape, "virtual", magnification, pitch)


def c_arm_views(
    system: PinholeSystem, shape: tuple[int, int] = (250, 250), pitch: ArrayLike = 2.0, lengths: float = 10.0
) -> Views:
    """The C-arm of the users' scripts: sources 5 l from the isocentre, detectors as far beyond it, 10 l apart.

    Each module's own l, along its principal ray, with its u and v: what DiffDRR gives with ``sdr=5 * l`` and the workbook's
    azimuth and elevation as Euler angles, seen with columns along u and rows along v.

    Parameters
    ----------
    system
    shape
        Pixels (n_v, n_u). The scripts use 250 or 256 both ways; their "FOV" is the middle half, "Wide FOV" all.
    pitch
        Pixel size, mm, one number or (pitch_u, pitch_v). The scripts use 1 or 2.
    lengths
        Distance from source to detector, in units of l.

    Raises
    ------
    InputError
        A shape or a number is not as above.
    """
    shape = whole_shape(shape, "image shape", 2)
    pitch_u, pitch_v = real_array(np.broadcast_to(pitch, 2) if np.ndim(pitch) == 0 else pitch, "pixel pitch", (2,))
    if min(pitch_u, pitch_v) <= 0:
        raise InputError(f"pixel pitch: expected more than 0 mm, got {min(pitch_u, pitch_v):g}")
    radius = positive(lengths, "lengths") / 2 * system.collimator_length[:, None]
    u, v, k = system.frames().transpose(1, 0, 2)
    return Views(-radius * k, radius * k, pitch_u * u, pitch_v * v, shape)
