"""Rays from the ROI to a pinhole that meet another module on their way.

Each pinhole centre is given `RAYS` rays over the cone of its ROI, from the axis to the sphere's silhouette, each standing
for the same solid angle (a spiral by the golden angle: H. Vogel, Math. Biosci. 44 (1979) 179-189), the same in every run.
A thousandth of the cone has about ten of them. A ray counts from the pinhole to where it leaves the ROI, and is cut by the
faces of the other parts' hulls exactly. A hull takes nothing away that is not hidden: a ray that enters a collimator through
its hole still ends in its wall or in the crystal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..system import PinholeSystem
from .hulls import TOUCH, Hulls
from .report import Blocked

RAYS = 10_000


def find_blocked(system: PinholeSystem, hulls: Hulls) -> tuple[Blocked, ...]:
    """All pairs of a module and another one that meets some of its rays."""
    found = []
    b, frames = system.pinhole_distance, system.frames()
    for m, number in enumerate(system.numbers.tolist()):
        radius, pinhole = system.roi_radius[m], system.centers[m]
        parts = _candidates(hulls, pinhole, frames[m, 2], b[m], radius)
        parts = parts[hulls.numbers[parts] != number]
        if len(parts) == 0:
            continue
        local = cone_directions(RAYS, np.sqrt(1 - (radius / b[m]) ** 2))
        along = b[m] * local[:, 2]
        leaves = along + np.sqrt(np.maximum(radius**2 - (b[m] ** 2 - along**2), 0.0))
        directions = local @ frames[m]
        for other in dict.fromkeys(hulls.numbers[parts].tolist()):
            hit = np.zeros(RAYS, dtype=bool)
            for p in parts[hulls.numbers[parts] == other]:
                hit |= meets(hulls, p, pinhole, directions, leaves)
            if hit.any():
                found.append(Blocked(number, other, float(hit.mean())))
    return tuple(found)


def cone_directions(n: int, cosine: float) -> NDArray[np.float64]:
    """`n` unit vectors (n, 3) evenly over the cone about z whose half-angle has that `cosine`."""
    index = np.arange(n)
    z = 1 - (1 - cosine) * (index + 0.5) / n
    angle = index * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def meets(
    hulls: Hulls,
    p: int,
    origin: NDArray[np.float64],
    directions: NDArray[np.float64],
    lengths: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Which rays (N,) from `origin` along unit `directions` (N, 3), of `lengths` (N,), run inside hull `p`."""
    towards = hulls.normals[p] @ directions.T
    towards[towards == 0] = -np.finfo(np.float64).tiny  # along a face: entered long ago, or never where it is outside
    outside = hulls.offsets[p] - hulls.normals[p] @ origin  # below 0 where the origin is on the face's outer side
    with np.errstate(over="ignore"):
        at = outside[:, None] / towards
    # No ray enters all faces of a closed body, nor leaves all: 0 and its length are among these.
    enters = np.where(towards < 0, at, 0.0).max(axis=0)
    leaves = np.where(towards > 0, at, lengths).min(axis=0)
    return leaves - enters > TOUCH


def _candidates(
    hulls: Hulls, pinhole: NDArray[np.float64], axis: NDArray[np.float64], b: float, radius: float
) -> NDArray[np.intp]:
    """Parts that the ROI's cone may meet: some corner is in front of the pinhole, and their sphere meets the cone."""
    in_front = ((hulls.vertices - pinhole) @ axis).max(axis=1) > 0
    to = hulls.centers - pinhole
    distance = np.linalg.norm(to, axis=1)
    near = distance - hulls.radii < b + radius
    around = distance <= hulls.radii
    with np.errstate(divide="ignore", invalid="ignore"):
        angle = np.arccos(np.clip(to @ axis / distance, -1, 1))
        width = np.arcsin(np.minimum(hulls.radii / distance, 1.0))
    return np.flatnonzero(in_front & near & (around | (angle < np.arcsin(radius / b) + width)))
