"""Visibility, magnification, sensitivity and resolution of modules for points anywhere.

In a module's frame a point (x_u, x_v) off the axis and at height h in front of the pinhole's plane is seen at the angle
psi to the axis, with ``cos(psi) = h / sqrt(h^2 + x_u^2 + x_v^2)``, which is the sine of its elevation theta above that
plane. Points, modules and optics may be torch tensors, some or all of them: the results are then part of their graph.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..arrays import ArrayOrTensor, checked, is_tensor
from ..geometry.design_formulas import roi_radius_seen
from ..geometry.system import PinholeSystem
from ..validation import instance, real_array
from .optics import IDEAL, Optics, chosen_optics


class Modules(NamedTuple):
    """Frames and dimensions of M modules as arrays or tensors, in place of a `PinholeSystem`."""

    centers: ArrayOrTensor  # (M, 3), mm
    frames: ArrayOrTensor  # (M, 3, 3), rows u, v, k
    pinhole_diameter: ArrayOrTensor  # (M,), mm
    collimator_length: ArrayOrTensor  # (M,), mm
    detector_side: ArrayOrTensor  # (M,), mm
    detector_thickness: ArrayOrTensor  # (M,), mm

    @classmethod
    def from_system(cls, system: PinholeSystem) -> Modules:
        """Return the modules of a system."""
        return cls(system.centers, system.frames(), *(getattr(system, name) for name in cls._fields[2:]))


def seen(system: PinholeSystem | Modules, points: ArrayOrTensor) -> ArrayOrTensor:
    """Return the mask (P, M) of the `points` (P, 3), world mm, that each of the M modules sees.

    A module sees a point in front of its pinhole if the ray from the point through the pinhole's centre meets the crystal's
    front face, ``l max(|x_u|, |x_v|) <= Ld h / 2``.
    """
    modules, _, *coordinates = _in_modules(system, points)
    return _visible(modules, *coordinates)


def magnification(system: PinholeSystem | Modules, points: ArrayOrTensor) -> ArrayOrTensor:
    """Return the magnification l / h (P, M) at each of the `points` (P, 3), world mm; NaN behind the pinhole."""
    modules, optics, _, _, h = _in_modules(system, points)
    where = optics.library.where
    return where(h > 0, modules.collimator_length / where(h > 0, h, 1.0), np.nan)


def sensitivity(
    system: PinholeSystem | Modules, points: ArrayOrTensor, *, optics: Optics | None = None, **settings: Any
) -> ArrayOrTensor:
    """Return the counts per decay (P, M) of a point source in each module (times 1e6: cps/MBq).

    If a module sees the point, they are ``photons_per_decay d_e^2 sin^3(theta) / (16 h^2)`` times the fraction
    ``1 - exp(-crystal_mu Td / sin(theta))`` that the crystal stops; otherwise 0. The law of `Emission`, pixel by pixel, is
    the same.

    Parameters
    ----------
    system
        System, or `Modules`.
    points
        Points (P, 3), world mm.
    optics
        Optics of the modules, such as `Emission.optics`. None: ideal ones.
    settings
        Attributes of `Optics`, in place of those of `optics`: `aperture_mu`, `opening_angle`, `crystal_mu`,
        `photons_per_decay`, `within_cone` and so on.

    Raises
    ------
    InputError
        If an attribute of the optics has not as many numbers as there are modules.
    """
    modules, optics, x_u, x_v, h = _in_modules(system, points, chosen_optics(optics, settings))
    visible = _visible(modules, x_u, x_v, h)
    h = optics.library.where(visible, h, 1.0)  # avoids a division by zero
    slope_u, slope_v = x_u / h, x_v / h
    (opening,) = optics.openings(modules.pinhole_diameter)
    counts: Any = 0.0
    for layer, depth in enumerate(optics.depths(modules.detector_thickness)):
        counted, cosine = optics.counted(slope_u, slope_v, opening, modules.detector_thickness, layer)
        if layer and optics.within_crystal:  # deep photons are recorded farther out than they entered
            widest = modules.detector_side / 2 / (modules.collimator_length + depth)
            counted = counted * ((abs(slope_u) <= widest) & (abs(slope_v) <= widest))
        counts = counts + counted
    return counts * visible / (h**2 * cosine)


def resolution(
    system: PinholeSystem | Modules, points: ArrayOrTensor, *, optics: Optics | None = None, **settings: Any
) -> ArrayOrTensor:
    """Return the FWHM in object space (P, M), mm, across each module's axis; NaN if the module does not see the point.

    It is ``R^2 = (d_re (1 + h / l))^2 + (R_i h / l)^2`` with ``d_re = d + ln(2) / mu tan(alpha / 2)``, the diameter at which
    the knife edge transmits half of the photons (Accorsi and Metzler 2004, along the axis), and the detector's
    `intrinsic_fwhm` R_i. The arguments are those of `sensitivity`.
    """
    modules, optics, x_u, x_v, h = _in_modules(system, points, chosen_optics(optics, settings))
    fwhm = _fwhm(h / modules.collimator_length, modules.pinhole_diameter, optics)
    return optics.library.where(_visible(modules, x_u, x_v, h), fwhm, np.nan)


class ModulePerformance(NamedTuple):
    """Performance of modules at the isocentre."""

    sensitivity: ArrayOrTensor  # counts per decay
    resolution: ArrayOrTensor  # FWHM in object space, mm
    magnification: ArrayOrTensor  # l / b
    roi_radius_seen: ArrayOrTensor  # radius of the largest sphere in the field of view, mm


def isocentre_performance(
    b: ArrayOrTensor,
    d: ArrayOrTensor,
    l: ArrayOrTensor,
    Ld: ArrayOrTensor,
    Td: ArrayOrTensor,
    *,
    optics: Optics | None = None,
    **settings: Any,
) -> ModulePerformance:
    """Return the performance of one module or many at the isocentre, from their dimensions alone.

    The function is fast enough for live readouts. b is the distance from pinhole to isocentre, d the hole's diameter, l the
    collimator length, Ld and Td the side and thickness of the crystal, mm: numbers, arrays or tensors that broadcast.
    `optics` and `settings` are those of `sensitivity`.
    """
    radius = roi_radius_seen(b, d, Ld, l)
    numbers = (x if is_tensor(x) else np.asarray(x, np.float64) for x in (b, d, l, Td, 0.0))
    optics, b, d, l, Td, zero = chosen_optics(optics, settings).promoted(*numbers)
    (opening,) = optics.openings(d)
    counts = sum(optics.counted(zero, zero, opening, Td, layer)[0] for layer in range(optics.depth_layers)) / b**2
    return ModulePerformance(counts, _fwhm(b / l, d, optics), l / b, radius)


def _in_modules(
    system: PinholeSystem | Modules, points: Any, optics: Optics = IDEAL
) -> tuple[Modules, Optics, ArrayOrTensor, ArrayOrTensor, ArrayOrTensor]:
    """Return modules and optics, and the coordinates x_u, x_v and h (P, M), mm, of points (P, 3) in the modules' frames.

    All are arrays, or all are tensors of one type and device.
    """
    if is_tensor(points):
        points = checked(points, "points", (*points.shape[:1], 3), False)
    else:
        points = real_array(points, "points", (None, 3))
    if not isinstance(system, Modules):
        instance(system, PinholeSystem, "system")
        system = Modules.from_system(system)
    optics, points, *numbers = optics.of_modules(slice(None), len(system.centers)).promoted(points, *system)
    modules = Modules(*numbers)
    x_u, x_v, h = (points @ axis.T - (modules.centers * axis).sum(1) for axis in modules.frames.swapaxes(0, 1))
    return modules, optics, x_u, x_v, h


def _visible(modules: Modules, x_u: ArrayOrTensor, x_v: ArrayOrTensor, h: ArrayOrTensor) -> ArrayOrTensor:
    """Return the mask (P, M) of points at the coordinates x_u, x_v and h (P, M), mm, that modules see."""
    half_width = modules.detector_side / (2 * modules.collimator_length) * h
    return (h > 0) & (abs(x_u) <= half_width) & (abs(x_v) <= half_width)


def _fwhm(h_per_l: ArrayOrTensor, diameter: ArrayOrTensor, optics: Optics) -> ArrayOrTensor:
    """Return the FWHM in object space, mm, for holes of this `diameter`, mm, at the ratio h / l."""
    hole_fwhm = optics.half_value_diameter(diameter) * (1 + h_per_l)
    return (hole_fwhm**2 + (optics.intrinsic_fwhm * h_per_l) ** 2) ** 0.5
