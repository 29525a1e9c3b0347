"""Checks of aperture plates: too thick for the opening angle of their hole, or too thin to stop the photons.

`Emission` treats a plate as infinitely thick. That is right for plates that neither shade their hole from the ROI nor let
photons through beside it; all others are found here.
"""

import math
from collections.abc import Sequence

from ...validation import positive
from ..collimator import Collimator, edge_slope
from ..system import PinholeSystem
from .report import ThinPlate, Vignetted

MIN_OPEN_SHARE = 0.99
"""Fraction of a hole's area that must be open to every ray from its ROI."""
MAX_TRANSMITTED = 0.01
"""Photons that may pass a plate beside its hole, relative to those that pass the hole."""


def find_vignetted(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[Vignetted, ...]:
    """Find the modules whose plate leaves less than `MIN_OPEN_SHARE` of the hole open to the steepest rays from the ROI."""
    findings = []
    b, radius, isocentres = system.pinhole_distance.tolist(), system.roi_radius.tolist(), system.isocentres()
    for m, collimator in enumerate(collimators):
        if radius[m] >= b[m]:  # the pinhole is inside the ROI, which is reported as an intrusion
            continue
        needed = needed_angle(isocentres[m, 2], collimator.diameter, radius[m], math.hypot(*isocentres[m, :2]))
        if needed >= math.pi:  # tilted so far that the ROI reaches behind the plate
            continue
        share, plate = collimator.open_share(math.tan(needed / 2)), collimator.construction
        if share < MIN_OPEN_SHARE:
            number = int(system.numbers[m])
            findings.append(Vignetted(number, share, plate.plate_thickness, plate.opening_angle, needed))
    return tuple(findings)


def needed_angle(b: float, d: float, radius: float, aside: float = 0.0) -> float:
    """Return the smallest opening angle, rad, with which a plate of any thickness leaves the hole open to the whole ROI.

    It is twice the steepest ray's angle to the axis; that ray is tangent to the ROI and passes the hole's far rim.
    `b`, `d` and `radius` (below b) are in mm; for a tilted module, b is the isocentre's height above the pinhole plane and
    `aside` its distance from the axis.
    """
    across = aside + d / 2
    return 2 * (math.atan2(across, b) + math.asin(min(radius / math.hypot(b, across), 1.0)))


def find_thin_plates(
    system: PinholeSystem, collimators: Sequence[Collimator], aperture_mu: float
) -> tuple[ThinPlate, ...]:
    """Find the modules at which more than `MAX_TRANSMITTED` of the photons along the axis pass the plate beside the hole.

    The area beside the hole is the one with the plate's full thickness, out to the rim of its front.
    """
    mu = positive(aperture_mu, "aperture_mu", "1/mm")
    findings = []
    for number, collimator in zip(system.numbers.tolist(), collimators, strict=True):
        plate = collimator.construction
        transmission = math.exp(-mu * plate.plate_thickness)
        widest = max(collimator.hole_radius(plate.front), collimator.hole_radius(plate.back))
        plate_area = (2 * collimator.front_half_width) ** 2 - math.pi * widest**2
        # Paix's effective area, of which core.physics.optics has the whole law
        hole_area = math.pi / 4 * collimator.diameter * (collimator.diameter + 2 / mu * edge_slope(plate.opening_angle))
        if (share := transmission * plate_area / hole_area) > MAX_TRANSMITTED:
            findings.append(ThinPlate(number, plate.plate_thickness, transmission, share))
    return tuple(findings)
