"""Pinholes and modules at places where they cannot be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..collimator import Collimator, Construction
from ..system import PinholeSystem
from .hulls import TOUCH, Hulls
from .report import Intrusion, NearPair, SwallowedPinhole


def find_near_pairs(system: PinholeSystem, collimators: Sequence[Collimator]) -> tuple[NearPair, ...]:
    """Modules whose pinholes are closer together than two fronts side by side."""
    half = np.array([body.front_half_width for body in collimators])
    found = []
    for m, number in enumerate(system.numbers.tolist()):
        distance = np.linalg.norm(system.centers[m + 1 :] - system.centers[m], axis=1)
        near = np.flatnonzero(distance < half[m + 1 :] + half[m] - TOUCH)
        found += [NearPair(number, int(system.numbers[m + 1 + n]), float(distance[n])) for n in near]
    return tuple(found)


def find_swallowed_pinholes(system: PinholeSystem, hulls: Hulls) -> tuple[SwallowedPinhole, ...]:
    """Pinhole centres more than `TOUCH` inside another module's part."""
    found = []
    for number, center in zip(system.numbers.tolist(), system.centers, strict=True):
        depth = (hulls.offsets - hulls.normals @ center).min(axis=1)
        found += [
            SwallowedPinhole(number, int(hulls.numbers[p]), hulls.kinds[p], float(depth[p]))
            for p in np.flatnonzero((depth > TOUCH) & (hulls.numbers != number))
        ]
    return tuple(found)


def find_intrusions(system: PinholeSystem, construction: Construction) -> tuple[Intrusion, ...]:
    """Modules that reach into the largest ROI.

    A module's front is across its axis, and the axis meets the isocentre: its nearest point is the middle of the plate's
    front face.
    """
    radius = float(system.roi_radius.max())
    depth = radius - (system.pinhole_distance + construction.front)
    return tuple(Intrusion(int(system.numbers[m]), radius, float(depth[m])) for m in np.flatnonzero(depth > TOUCH))
