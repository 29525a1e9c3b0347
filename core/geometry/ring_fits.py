"""The rings of a given system: the order of their modules, and the ellipse that each follows."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Floats, Indexes, Integers
from ..errors import InputError
from ..validation import instance
from .ellipse import Ellipse, fit_ellipse
from .generators import FULL_TURN, Spacing, even_azimuths
from .system import PinholeSystem

_ON_AXIS = 1e-9  # of the distance from the isocentre
# A ring is open if its largest gap is more than this many mean gaps.
_OPEN_GAP = 2.0


@dataclass(frozen=True, eq=False)
class RingFit:
    """The ellipse that one ring of a system follows, and how far its modules are from being evenly spaced on it.

    Lengths are in mm and angles in rad, as `ellipse_rings` takes them.
    """

    numbers: Integers  # (M,), in their order along the ring; an open ring begins at one end
    semi_axes: Floats
    center: Floats
    rotation: float  # at most 45 degrees either way
    azimuths: Floats  # (M,), monotonic, without jumps
    z: Floats  # (M,)
    spacing: Spacing  # whichever even spacing from the first to the last azimuth comes closer
    curve_deviation: float  # largest distance of a pinhole from the ellipse at its own z
    even_deviation: float  # largest distance of a pinhole from its place in an evenly spaced ring at the mean z

    def parameters(self, even: bool = False) -> dict[str, Any]:
        """Arguments of `ellipse_rings` that regenerate the ring.

        They are every module's azimuth and z, or if `even` the number of modules, the ends, the spacing and the mean z.
        """
        curve = {"semi_axes": self.semi_axes, "center": self.center, "rotation": self.rotation}
        if not even:
            return {"modules": self.azimuths, "z": self.z[None], **curve}
        first, last = float(self.azimuths[0]), float(self.azimuths[-1])
        ends = {"modules": len(self.azimuths), "start": first, "end": last, "spacing": self.spacing}
        return {**ends, "z": float(self.z.mean()), **curve}


def fit_rings(system: PinholeSystem) -> list[RingFit]:
    """The arguments of `ellipse_rings` that come closest to a system, for each of its rings along +z.

    Each ellipse has the least squared distances from the ring's pinholes. A ring of fewer than 6 modules, or one that no
    ellipse around the isocentre fits, is described by the circle about the isocentre with the mean radius. A module on the
    z axis, where it has no azimuth, is refused.
    """
    instance(system, PinholeSystem, "fit_rings")
    on_axis = np.hypot(*system.centers.T[:2]) <= _ON_AXIS * system.pinhole_distance
    if on_axis.any():
        raise InputError(f"module {system.numbers[np.argmax(on_axis)]}: stands on the z axis, not on a ring around it")
    return [_fit(system, which) for which in _rings(system)]


def ring_order(system: PinholeSystem) -> Indexes:
    """Indexes (M,) of the modules, ring by ring along +z, and along each ring in the direction that most already follow.

    An open ring begins at its gap, a closed one with the module that comes first in the system.
    ``system[ring_order(system)]`` is the system in that order; modules keep their numbers.
    """
    instance(system, PinholeSystem, "ring_order")
    rings = _rings(system)
    clockwise = _run_clockwise(system, rings)
    return np.concatenate([_in_order(system, which, clockwise)[1] for which in rings])


def _rings(system: PinholeSystem) -> list[Indexes]:
    """Indexes of the modules of each ring."""
    ring_of = system.rings()
    return [np.flatnonzero(ring_of == ring) for ring in range(ring_of.max() + 1)]


def _fit(system: PinholeSystem, which: Indexes) -> RingFit:
    azimuths, which = _in_order(system, which, _run_clockwise(system, [which]))
    places, z = system.centers[which, :2], system.centers[which, 2]
    ellipse = fit_ellipse(places)
    if ellipse is None:
        radius = float(np.linalg.norm(places, axis=1).mean())
        ellipse = Ellipse(np.full(2, radius), np.zeros(2), 0.0)
    deviations: dict[Spacing, float] = {}
    spacings: tuple[Spacing, ...] = ("angle", "arc")
    for spacing in spacings:
        even = even_azimuths(ellipse, len(which), azimuths[0], azimuths[-1], spacing)
        off = np.concatenate([ellipse.at(even) - places, (z.mean() - z)[:, None]], axis=1)
        deviations[spacing] = float(np.linalg.norm(off, axis=1).max())
    best = min(spacings, key=lambda name: deviations[name])
    off_curve = float(np.abs(ellipse.distances(places)[0]).max())
    curve = (ellipse.semi_axes, ellipse.center, ellipse.rotation)
    return RingFit(system.numbers[which], *curve, azimuths, z, best, off_curve, deviations[best])


def _run_clockwise(system: PinholeSystem, rings: Sequence[Indexes]) -> bool:
    """Whether azimuths decrease along most of the rings."""
    orders = [np.argsort(np.arctan2(*system.centers[which, 1::-1].T), kind="stable") for which in rings]
    falls = sum(np.count_nonzero(np.diff(order) < 0) for order in orders)
    return bool(2 * falls > sum(len(order) for order in orders))


def _in_order(system: PinholeSystem, which: Indexes, clockwise: bool) -> tuple[Floats, Indexes]:
    """Azimuths without jumps of the modules `which`, and these modules, in their order along the ring."""
    azimuths = np.arctan2(*system.centers[which, 1::-1].T)
    order = np.argsort(azimuths, kind="stable")
    if clockwise:
        order = order[::-1]
    steps = np.diff(azimuths[order], append=azimuths[order[0]])
    gaps = np.mod(-steps if clockwise else steps, FULL_TURN)
    closed = gaps.max() < _OPEN_GAP * FULL_TURN / len(which)
    first = int(np.argmin(order)) if closed else int(np.argmax(gaps)) + 1
    order = np.roll(order, -first)
    return np.unwrap(azimuths[order]), which[order]
