"""Aperture plates that are too thick for the opening angle of their hole, or too thin to stop the photons.

`Emission` treats the plate as infinitely thick, which is right for plates that neither shade their hole from the ROI nor let
photons through beside it. All others are found here.
"""

import math
from collections.abc import Sequence

from ...physics.optics import Optics
from ...validation import positive
from ..collimator import Collimator
from ..system import PinholeSystem
from .report import ThinPlate, Vignetted

FEWEST_OPEN = 0.99
"""Fraction of a hole that must be open to every ray from its ROI."""
MOST_THROUGH = 0.01
"""Photons that may pass a plate beside its hole, relative to those that pass the hole."""


def find_vignetted(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[Vignetted, ...]:
    """Modules whose plate leaves less than `FEWEST_OPEN` of the hole open to the steepest rays from their ROI."""
    found = []
    b, radius, isocentres = system.pinhole_distance.tolist(), system.roi_radius.tolist(), system.isocentres()
    for m, body in enumerate(collimators):
        if radius[m] >= b[m]:  # the pinhole is inside the ROI, which is found as an intrusion
            continue
        needed = needed_angle(isocentres[m, 2], body.diameter, radius[m], math.hypot(*isocentres[m, :2]))
        if needed >= math.pi:  # tilted so far that its ROI reaches behind the plate
            continue
        share, built = body.open_share(math.tan(needed / 2)), body.construction
        if share < FEWEST_OPEN:
            number = int(system.numbers[m])
            found.append(Vignetted(number, share, built.plate_thickness, built.opening_angle, needed))
    return tuple(found)


def needed_angle(b: float, d: float, radius: float, aside: float = 0.0) -> float:
    """The smallest opening angle, rad, at which a plate of any thickness leaves the whole hole open to the whole ROI.

    It is twice the steepest ray's angle to the axis; that ray is tangent to the ROI and passes the hole's far rim.
    `b`, `d` and `radius` (below b) are in mm; of a tilted module, b is the isocentre's height above the pinhole plane and
    `aside` its distance from the axis.
    """
    across = aside + d / 2
    return 2 * (math.atan2(across, b) + math.asin(min(radius / math.hypot(b, across), 1.0)))


def find_thin_plates(
    system: PinholeSystem, collimators: Sequence[Collimator], aperture_mu: float
) -> tuple[ThinPlate, ...]:
    """Modules where more than `MOST_THROUGH` of the photons along the axis pass the plate beside the hole.

    Beside the hole is where the plate has its full thickness, out to the rim of its front.
    """
    mu = positive(aperture_mu, "aperture_mu", "1/mm")
    found = []
    for number, body in zip(system.numbers.tolist(), collimators, strict=True):
        built = body.construction
        transmission = math.exp(-mu * built.plate_thickness)
        widest = max(body.hole_radius(built.front), body.hole_radius(built.back))
        beside = (2 * body.front_half_width) ** 2 - math.pi * widest**2
        optics = Optics(aperture_mu=mu, opening_angle=built.opening_angle)
        hole = math.pi / 4 * optics.effective_diameter(body.diameter) ** 2
        share = transmission * beside / hole
        if share > MOST_THROUGH:
            found.append(ThinPlate(number, built.plate_thickness, transmission, share))
    return tuple(found)
