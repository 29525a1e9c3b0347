"""Rings of an existing system: the order of their modules, and the ellipse that fits each ring."""

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

# Distance from the z axis, relative to that from the isocentre, up to which a module has no azimuth.
_ON_AXIS = 1e-9
# A ring is open if its largest gap is at least this many mean gaps.
_OPEN_GAP = 2.0


@dataclass(frozen=True, eq=False)
class RingFit:
    """Ellipse that fits one ring of a system, and the deviations of its modules from even spacing on it.

    Lengths are in mm and angles in rad, as `ellipse_rings` takes them.
    """

    numbers: Integers  # (M,), numbers of the modules in their order along the ring; an open ring begins at one end
    semi_axes: Floats  # (2,), mm
    center: Floats  # (2,), mm
    rotation: float  # rad, at most 45 degrees either way
    azimuths: Floats  # (M,), rad, monotonic, without jumps
    z: Floats  # (M,), mm
    spacing: Spacing  # the even spacing from the first to the last azimuth that comes closer to the modules
    curve_deviation: float  # largest distance, mm, of a pinhole from the ellipse at the pinhole's z
    even_deviation: float  # largest distance, mm, of a pinhole from its place in an evenly spaced ring at the mean z

    def parameters(self, even: bool = False) -> dict[str, Any]:
        """Return arguments of `ellipse_rings` that regenerate the ring.

        They are every module's azimuth and z, or, if `even`, the number of modules, the ends, the spacing and the mean z.
        """
        curve = {"semi_axes": self.semi_axes, "center": self.center, "rotation": self.rotation}
        if not even:
            return {"modules": self.azimuths, "z": self.z[None], **curve}
        first, last = float(self.azimuths[0]), float(self.azimuths[-1])
        ends = {"modules": len(self.azimuths), "start": first, "end": last, "spacing": self.spacing}
        return {**ends, "z": float(self.z.mean()), **curve}


def fit_rings(system: PinholeSystem) -> list[RingFit]:
    """Fit an ellipse to each ring of a system, along +z.

    An ellipse has the least sum of squared distances from the ring's pinholes. A ring of fewer than 6 modules, or one that
    no ellipse around the isocentre fits, is described by the circle about the isocentre with the mean radius. Raises
    `InputError` for a module on the z axis, where it has no azimuth.
    """
    instance(system, PinholeSystem, "fit_rings")
    on_axis = np.hypot(*system.centers.T[:2]) <= _ON_AXIS * system.pinhole_distance
    if on_axis.any():
        raise InputError(f"module {system.numbers[np.argmax(on_axis)]}: stands on the z axis, not on a ring around it")
    return [_fit_ring(system, modules) for modules in _rings(system)]


def ring_order(system: PinholeSystem) -> Indexes:
    """Return the indices (M,) of the modules, ring by ring along +z and in order along each ring.

    The direction along the rings is the one that most modules already follow. An open ring begins at its gap, a closed one
    with the module that comes first in the system. ``system[ring_order(system)]`` is the system in that order; modules keep
    their numbers.
    """
    instance(system, PinholeSystem, "ring_order")
    rings = _rings(system)
    clockwise = _is_clockwise(system, rings)
    return np.concatenate([_sort_ring(system, modules, clockwise)[1] for modules in rings])


def _rings(system: PinholeSystem) -> list[Indexes]:
    """Return the indices of the modules of each ring."""
    rings = system.rings()
    return [np.flatnonzero(rings == ring) for ring in range(rings.max() + 1)]


def _fit_ring(system: PinholeSystem, modules: Indexes) -> RingFit:
    """Fit an ellipse to the ring of the `modules`, indices (M,) in any order."""
    azimuths, modules = _sort_ring(system, modules, _is_clockwise(system, [modules]))
    points, z = system.centers[modules, :2], system.centers[modules, 2]
    if (ellipse := fit_ellipse(points)) is None:
        radius = float(np.linalg.norm(points, axis=1).mean())
        ellipse = Ellipse(np.full(2, radius), np.zeros(2), 0.0)
    deviations: dict[Spacing, float] = {}
    spacings: tuple[Spacing, ...] = ("angle", "arc")
    for spacing in spacings:
        even = even_azimuths(ellipse, len(modules), azimuths[0], azimuths[-1], spacing)
        offsets = np.concatenate([ellipse.points_at(even) - points, (z.mean() - z)[:, None]], axis=1)
        deviations[spacing] = float(np.linalg.norm(offsets, axis=1).max())
    best = min(spacings, key=lambda name: deviations[name])
    curve_deviation = float(np.abs(ellipse.distances(points)[0]).max())
    curve = (ellipse.semi_axes, ellipse.center, ellipse.rotation)
    return RingFit(system.numbers[modules], *curve, azimuths, z, best, curve_deviation, deviations[best])


def _is_clockwise(system: PinholeSystem, rings: Sequence[Indexes]) -> bool:
    """Return whether most modules of the `rings`, indices of modules, follow their predecessors at smaller azimuths."""
    orders = [np.argsort(np.arctan2(*system.centers[modules, 1::-1].T), kind="stable") for modules in rings]
    n_falls = sum(np.count_nonzero(np.diff(order) < 0) for order in orders)
    return bool(2 * n_falls > sum(len(order) for order in orders))


def _sort_ring(system: PinholeSystem, modules: Indexes, clockwise: bool) -> tuple[Floats, Indexes]:
    """Sort the `modules` of a ring along it; return their azimuths (M,), rad, without jumps, and their indices (M,)."""
    azimuths = np.arctan2(*system.centers[modules, 1::-1].T)
    order = np.argsort(azimuths, kind="stable")
    if clockwise:
        order = order[::-1]
    steps = np.diff(azimuths[order], append=azimuths[order[0]])
    gaps = np.mod(-steps if clockwise else steps, FULL_TURN)
    closed = gaps.max() < _OPEN_GAP * FULL_TURN / len(modules)
    first = int(np.argmin(order)) if closed else int(np.argmax(gaps)) + 1
    order = np.roll(order, -first)
    return np.unwrap(azimuths[order]), modules[order]
