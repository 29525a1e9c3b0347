"""Visibility, magnification, sensitivity and resolution of modules for points anywhere.

In a module's frame a point (x_u, x_v) off the axis and at height h in front of the pinhole's plane is seen at the angle
psi to the axis, with ``cos(psi) = h / sqrt(h^2 + x_u^2 + x_v^2)``, which is the sine of its elevation theta above that
plane.

References
----------
D. Paix, "Pinhole imaging of gamma rays", Physics in Medicine and Biology 12 (1967) 489-500.
R. Accorsi, S. D. Metzler, "Analytic determination of the resolution-equivalent effective diameter of a pinhole
collimator", IEEE Transactions on Medical Imaging 23 (2004) 750-763.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..geometry.collimator import OPENING_ANGLE
from ..geometry.design_formulas import roi_radius_seen
from ..geometry.system import PinholeSystem
from ..validation import instance, positive, real_array
from .aperture import half_value_diameter, paix_diameter
from .crystal import absorbed_share

Array = NDArray[np.float64]


def seen(system: PinholeSystem, points: ArrayLike) -> NDArray[np.bool_]:
    """Whether each of the M modules sees each of the `points` (P, 3), world mm: (P, M).

    A module sees a point in front of its pinhole if the ray from there through the pinhole's centre meets the crystal's
    front face, ``l max(|x_u|, |x_v|) <= Ld h / 2``.
    """
    return _seen(system, *_in_modules(system, points))


def magnification(system: PinholeSystem, points: ArrayLike) -> Array:
    """Magnification l / h (P, M) at each of the `points` (P, 3), world mm; NaN behind the pinhole."""
    _, _, h = _in_modules(system, points)
    with np.errstate(divide="ignore"):
        return np.where(h > 0, system.collimator_length / h, np.nan)


def sensitivity(
    system: PinholeSystem,
    points: ArrayLike,
    *,
    aperture_mu: float | None = None,
    opening_angle: float = OPENING_ANGLE,
    crystal_mu: float | None = None,
    photons_per_decay: float = 1.0,
) -> Array:
    """Counts per decay (P, M) of a point source in each module; times 1e6 that is cps/MBq.

    Where a module sees the point this is ``photons_per_decay d_e^2 sin^3(theta) / (16 h^2)`` times the fraction
    ``1 - exp(-crystal_mu Td / sin(theta))`` that the crystal stops; elsewhere it is 0. `Emission` with ``edge="paix"``
    counts the same, pixel by pixel.

    `aperture_mu` is the aperture's attenuation coefficient, 1/mm, and `opening_angle` the full angle of its knife edge, rad,
    for Paix's ``d_e^2 = d (d + 2 / mu tan(alpha / 2))``; without a coefficient nothing penetrates and d_e = d. `crystal_mu`
    is the crystal's, 1/mm; without it, all photons are stopped. `points` are as in `seen`.
    """
    x_u, x_v, h = _in_modules(system, points)
    _check_edge(aperture_mu, opening_angle)
    if crystal_mu is not None:
        crystal_mu = positive(crystal_mu, "crystal_mu", "1/mm")
    photons_per_decay = positive(photons_per_decay, "photons_per_decay")
    visible = _seen(system, x_u, x_v, h)
    h[~visible] = 1.0  # avoids dividing by zero
    cosine = h / np.sqrt(x_u**2 + x_v**2 + h**2)
    diameter = paix_diameter(system.pinhole_diameter, aperture_mu, opening_angle)
    counts = _counted(h, cosine, diameter, system.detector_thickness, crystal_mu)
    counts *= photons_per_decay * visible
    return counts


def resolution(
    system: PinholeSystem,
    points: ArrayLike,
    *,
    intrinsic_fwhm: float = 0.0,
    aperture_mu: float | None = None,
    opening_angle: float = OPENING_ANGLE,
) -> Array:
    """FWHM in object space (P, M), mm, across each module's axis; NaN where the module does not see the point.

    ``R^2 = (d_re (1 + h / l))^2 + (R_i h / l)^2`` with ``d_re = d + ln(2) / mu tan(alpha / 2)``, the diameter at which
    the knife edge transmits half of the photons (Accorsi and Metzler 2004, along the axis). `intrinsic_fwhm` is R_i, mm
    on the crystal; the other parameters are as in `sensitivity`.
    """
    x_u, x_v, h = _in_modules(system, points)
    _check_edge(aperture_mu, opening_angle)
    intrinsic_fwhm = float(real_array(intrinsic_fwhm, "intrinsic_fwhm", ()))
    if intrinsic_fwhm < 0:
        raise InputError(f"intrinsic_fwhm: expected 0 mm or more, got {intrinsic_fwhm:g}")
    diameter = half_value_diameter(system.pinhole_diameter, aperture_mu, opening_angle)
    fwhm = _fwhm(h / system.collimator_length, diameter, intrinsic_fwhm)
    fwhm[~_seen(system, x_u, x_v, h)] = np.nan
    return fwhm


class ModulePerformance(NamedTuple):
    """Performance at the isocentre."""

    sensitivity: Array  # counts per decay
    resolution: Array  # FWHM in object space, mm
    magnification: Array  # l / b
    roi_radius_seen: Array  # of the largest sphere that is seen whole, mm


def isocentre_performance(
    b: ArrayLike,
    d: ArrayLike,
    l: ArrayLike,
    Ld: ArrayLike,
    Td: ArrayLike,
    *,
    intrinsic_fwhm: float = 0.0,
    aperture_mu: float | None = None,
    opening_angle: float = OPENING_ANGLE,
    crystal_mu: float | None = None,
    photons_per_decay: float = 1.0,
) -> ModulePerformance:
    """Performance of one module or many at the isocentre, from their dimensions alone. It is fast, for live readouts.

    b is the distance from pinhole to isocentre, d the hole's diameter, l the collimator length, Ld and Td the side and
    thickness of the crystal, mm: numbers or arrays that broadcast. The options are those of `sensitivity` and
    `resolution`, but not checked.
    """
    radius = roi_radius_seen(b, d, Ld, l)
    b, d, l, Td = (np.asarray(x, dtype=np.float64) for x in (b, d, l, Td))
    return ModulePerformance(
        photons_per_decay * _counted(b, np.ones(()), paix_diameter(d, aperture_mu, opening_angle), Td, crystal_mu),
        _fwhm(b / l, half_value_diameter(d, aperture_mu, opening_angle), intrinsic_fwhm),
        l / b,
        radius,
    )


def _in_modules(system: PinholeSystem, points: ArrayLike) -> tuple[Array, Array, Array]:
    """x_u, x_v and h (P, M), mm, of points (P, 3) in the modules' frames; checks both."""
    points = real_array(points, "points", (None, 3))
    instance(system, PinholeSystem, "system")
    u, v, k = system.frames().transpose(1, 2, 0)
    return points @ u, points @ v, points @ k + system.pinhole_distance


def _seen(system: PinholeSystem, x_u: Array, x_v: Array, h: Array) -> NDArray[np.bool_]:
    reach = system.detector_side / (2 * system.collimator_length) * h
    return (h > 0) & (np.abs(x_u) <= reach) & (np.abs(x_v) <= reach)


def _counted(h: Array, cosine: Array, diameter: Array, thickness: Array, crystal_mu: float | None) -> Array:
    """Fraction of a point's photons that pass the hole and are stopped by the crystal."""
    passed = (diameter / h) ** 2 * cosine * cosine * cosine / 16
    if crystal_mu is None:
        return passed
    return passed * absorbed_share(cosine, crystal_mu, thickness, np.zeros(1), 0)  # type: ignore[arg-type]


def _fwhm(h_per_l: Array, diameter: Array, intrinsic_fwhm: float) -> Array:
    return np.hypot(diameter * (1 + h_per_l), intrinsic_fwhm * h_per_l)


def _check_edge(aperture_mu: float | None, opening_angle: float) -> None:
    if aperture_mu is not None:
        positive(aperture_mu, "aperture_mu", "1/mm")
    if positive(opening_angle, "opening_angle", "rad") >= math.pi:
        raise InputError(f"opening_angle: expected less than pi, got {opening_angle:g} rad")
