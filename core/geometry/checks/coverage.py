"""The field of view beside the ROI.

A module sees a point fully if its rays through every point of the hole meet the crystal: at depth x in front of the
pinhole these are the points within ``w(x) = x s - d/2`` of the axis along u and along v, with ``s = (Ld - d)/(2 l)``.
The largest sphere at the isocentre in it has the radius `core.design.roi_radius_seen`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..design_formulas import roi_radius_seen
from ..system import PinholeSystem
from .report import Uncovered

SLACK = 0.01
"""mm of radius by which the field of view may fall short: what l rounded to 0.01 mm brings about."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)  # type: ignore[no-untyped-call]


def find_uncovered(system: PinholeSystem) -> tuple[Uncovered, ...]:
    """The modules whose field of view falls short of their ROI by more than `SLACK`."""
    b, d, radius = system.pinhole_distance, system.pinhole_diameter, system.roi_radius
    slope = (system.detector_side - d) / (2 * system.collimator_length)
    seen = roi_radius_seen(b, d, system.detector_side, system.collimator_length)
    return tuple(
        Uncovered(
            module=int(system.numbers[m]),
            roi_radius=float(radius[m]),
            seen_radius=float(seen[m]),
            unseen_share=unseen_share(float(b[m]), float(d[m]), float(slope[m]), float(radius[m])),
        )
        for m in np.flatnonzero(radius - seen > SLACK)
    )


def unseen_share(b: float, d: float, slope: float, radius: float) -> float:
    """Share of the volume of the sphere of `radius` around the isocentre that is outside the field of view.

    The volume is summed over planes across the axis, in each of which the field of view is a square of half-width
    w(x) and the sphere a disc around the same middle.
    """
    ends = [b - radius, b + radius]
    # The square's corners and sides reach the disc's rim where c w^2 = radius^2 - (x - b)^2, with c = 2 and 1.
    for c in (2.0, 1.0):
        ends += _real_roots(c * slope**2 + 1, -(c * slope * d + 2 * b), c * d**2 / 4 + b**2 - radius**2)
    ends.append(d / (2 * slope))  # the pyramid's apex
    planes = np.unique(np.clip(ends, b - radius, b + radius))
    low, high = planes[:-1, None], planes[1:, None]
    # Equal steps of an angle: the integrand has square roots at the ends of the pieces.
    angle = (_NODES + 1) * np.pi / 2
    x = low + (high - low) * (1 - np.cos(angle)) / 2
    weight = (high - low) / 2 * np.sin(angle) * _WEIGHTS * np.pi / 2
    unseen = _outside_square(np.sqrt(np.maximum(radius**2 - (x - b) ** 2, 0.0)), x * slope - d / 2)
    return float((weight * unseen).sum() / (4 / 3 * np.pi * radius**3))


def _outside_square(disc: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Area of discs of radius `disc` outside the concentric squares of half-width `half`, mm^2."""
    inside = np.clip(half, 0.0, disc)
    with np.errstate(invalid="ignore"):
        segments = 4 * (disc**2 * np.arccos(inside / disc) - inside * np.sqrt(disc**2 - inside**2))
    return np.where(inside**2 * 2 <= disc**2, np.pi * disc**2 - 4 * inside**2, segments)


def _real_roots(a: float, b: float, c: float) -> list[float]:
    """Roots of a x^2 + b x + c."""
    under = b * b - 4 * a * c
    return [] if under < 0 else [(-b - np.sqrt(under)) / (2 * a), (-b + np.sqrt(under)) / (2 * a)]
