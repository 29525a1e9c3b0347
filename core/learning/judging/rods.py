"""Contrast of single rods in a volume, at places where a rod is or could be."""

import numpy as np

from ...arrays import ArrayLike, Floats
from ...geometry.frames import moved
from ...phantoms.derenzo import DerenzoPhantom
from ...volumes.resampling import values_at
from ...volumes.volume import Volume

PRESENT = 0.5
"""Share of its contrast above which a rod is seen."""
_LENGTH = 0.5  # central share of the rods' length over which means are taken
_INNER = 0.25  # radius, in diameters, of the circle that, with the axis, samples the rod
_OUTER = 1.0  # radius, in diameters, of the circle halfway to the neighbours
_ANGLES, _DEPTHS = 24, 9  # number of samples around a circle and along the rod


def rod_contrasts(volume: Volume, phantom: DerenzoPhantom, pose: ArrayLike, rods: ArrayLike) -> Floats:
    """Return the contrast recovery of each rod in a volume: its contrast divided by that of the phantom.

    The contrast is the mean in the rod minus that on the circle halfway to its neighbours, over the central half of its
    length. Recovery is 1 for the truth, 0 where no rod can be seen, NaN if nothing around the rod is background. Points on
    the circle that lie in a rod of another sector are left out.

    Parameters
    ----------
    volume
        On any grid.
    phantom
        Its activities, height and surrounding rods are used; the rods in question need not be among its own.
    pose
        World-from-phantom (4, 4), mm.
    rods
        (n, 4), as `DerenzoPhantom.rods` returns them: sector, x, y, diameter, mm.
    """
    world, contrasts = np.asarray(pose, float), []
    for _, x, y, diameter in np.asarray(rods, float):
        rod, circle = (_points((x, y), diameter * np.array(r), phantom.height) for r in ((0.0, _INNER), (_OUTER,)))
        free = np.isclose(phantom.values(circle), phantom.background)
        if not free.any():
            contrasts.append(np.nan)
            continue
        peak, valley = (values_at(volume, moved(world, points)).mean() for points in (rod, circle[free]))
        contrasts.append(float(peak - valley) / (phantom.activity - phantom.background))
    return np.array(contrasts, np.float64)


def _points(center: tuple[float, float], radii: Floats, height: float) -> Floats:
    """Return points (n, 3) on circles around a rod's axis, over the central part of its length."""
    angles = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    depths = ((np.arange(_DEPTHS) + 0.5) / _DEPTHS - 0.5) * _LENGTH * height
    radius, angle, z = np.meshgrid(radii, angles, depths, indexing="ij")
    return np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle), z], -1).reshape(-1, 3)
