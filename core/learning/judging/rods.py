"""Single rods: how much of its contrast a volume shows at a place where a rod is, or where one could be."""

import numpy as np

from ...arrays import ArrayLike, Floats
from ...geometry.frames import moved
from ...phantoms.derenzo import DerenzoPhantom
from ...volumes.resampling import values_at
from ...volumes.volume import Volume

PRESENT = 0.5
"""A rod is seen where more than this share of its contrast is."""
_LENGTH = 0.5  # of the rods' length, around its middle, that means are over
_INNER = 0.25  # diameters from its axis: the circle that, with the axis, stands for the rod
_OUTER = 1.0  # diameters from its axis: halfway to its neighbours
_ANGLES, _DEPTHS = 24, 9


def rod_contrasts(volume: Volume, phantom: DerenzoPhantom, pose: ArrayLike, rods: ArrayLike) -> Floats:
    """The contrast that a volume shows of each rod, by that between the phantom's rods and what is around them.

    It is the mean in the rod's middle minus that on the circle halfway to its neighbours, over the middle half of its
    length, by the phantom's difference: 1 for the truth, 0 where no rod can be seen, NaN without any difference. Places on
    the circle that lie in a rod of another sector are left out.

    Parameters
    ----------
    volume
        On any grid.
    phantom
        Its activities, height and rods around count; the rods in question need not be among its own.
    pose
        World-from-phantom (4, 4), mm.
    rods
        (n, 4), as `DerenzoPhantom.rods` gives them: sector, x, y, diameter, mm.
    """
    world, found = np.asarray(pose, float), []
    for _, x, y, diameter in np.asarray(rods, float):
        inside, around = (_points((x, y), diameter * np.array(r), phantom.height) for r in ((0.0, _INNER), (_OUTER,)))
        free = np.isclose(phantom.values(around), phantom.background)
        if not free.any():
            found.append(np.nan)
            continue
        peak, valley = (values_at(volume, moved(world, points)).mean() for points in (inside, around[free]))
        found.append(float(peak - valley) / (phantom.activity - phantom.background))
    return np.array(found, np.float64)


def _points(middle: tuple[float, float], radii: Floats, height: float) -> Floats:
    """Points (n, 3) on circles around a rod's axis, over the part of its length that counts."""
    angles = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    depths = ((np.arange(_DEPTHS) + 0.5) / _DEPTHS - 0.5) * _LENGTH * height
    radius, angle, z = np.meshgrid(radii, angles, depths, indexing="ij")
    return np.stack([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle), z], -1).reshape(-1, 3)
