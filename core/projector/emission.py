"""SPECT: how many photons a pixel of the crystal counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..checks import positive
from ..errors import InputError
from ..grid import Grid
from ..system import PinholeSystem
from ..views import Views
from ..volume import Volume
from .models import Beam, Model

# Views may differ from the system they are said to be of by a file's rounding (mm; sine of an angle).
_SAME_PLACE = 1e-3
_SAME_PLANE = 1e-6


@dataclass(frozen=True, eq=False)
class Emission(Model):
    """Expected counts per pixel of a volume of activity (kBq/mL, which is decays per s and mm^3).

    A ray of the pixel that leaves the pinhole at an angle psi to the principal ray counts ::

        time * d^2 p_u p_v cos^4(psi) / (16 l^2) * integral of f exp(-integral of mu) dr

    with p the pixel pitch on the crystal (of a virtual detector's pixel: its image there), d the pinhole's diameter
    and l the collimator's length. Summed over the pixels that is the law of a point source at height h above the
    pinhole's plane, seen at elevation theta: ``g = d^2 sin^3(theta) / (16 h^2)``. The 1/r^2 of that law is in the
    density of the rays. The rays run from the pinhole through the whole grid, wherever a virtual detector stands.

    Attributes
    ----------
    system : PinholeSystem
        The modules, as many as the views and in their order: ``Emission(system[0:20])`` for
        ``system[0:20].views(...)``.
    mu : Volume, optional
        What attenuates the photons between each point and the pinhole ("mu", 1/mm), at the energy that is counted: on
        any grid, the activity's or another. It is exact for the piecewise constant volumes: nothing is resampled, a
        ray is cut by the planes of both grids, and inside a voxel ``exp(-integral of mu)`` is integrated in closed
        form. None: no attenuation.
    time : float
        Of the acquisition, s.
    photons_per_decay : float
        Photons of the energy that is counted, per decay.

    Raises
    ------
    InputError
        An argument is of another kind or out of its range.
    """

    system: PinholeSystem
    mu: Volume | None = None
    time: float = 1.0
    photons_per_decay: float = 1.0

    name = "emission"

    def __post_init__(self) -> None:
        if not isinstance(self.system, PinholeSystem):
            raise InputError(f"emission: expected a PinholeSystem, got {type(self.system).__name__}")
        if self.mu is not None:
            if not isinstance(self.mu, Volume):
                raise InputError(f"emission: expected mu to be a Volume (no tensor), got {type(self.mu).__name__}")
            if self.mu.quantity != "mu":
                raise InputError(f"emission: expected a volume of mu, got {self.mu.quantity}")
            if self.mu.array.min() < 0:
                raise InputError(f"emission: mu must not be negative, got {self.mu.array.min():g} 1/mm")
        for name in ("time", "photons_per_decay"):
            object.__setattr__(self, name, positive(getattr(self, name), f"emission: {name}"))

    def unit(self, volume: Volume) -> str:
        """Unit of the images of `volume`."""
        return "counts"

    def check_volume(self, volume: Volume) -> None:
        """Raise `InputError` unless `volume` holds activity."""
        if volume.quantity != "activity":
            raise InputError(f"emission: expected a volume of activity, got {volume.quantity}")

    def check(self, views: Views) -> None:
        """Raise `InputError` unless `views` are of this system."""
        if len(views) != len(self.system):
            raise InputError(
                f"emission: {len(self.system)} modules but {len(views)} views; give the system whose views they are"
            )
        principal = self.system.principal_rays
        moved = np.linalg.norm(views.sources - self.system.centers, axis=1) > _SAME_PLACE
        tilted = np.zeros(len(views), dtype=bool)
        for steps in (views.u_steps, views.v_steps):
            sine = np.einsum("mi,mi->m", steps, principal) / np.linalg.norm(steps, axis=1)
            tilted |= np.abs(sine) > _SAME_PLANE
        behind = np.einsum("mi,mi->m", views.detector_centers - views.sources, principal) <= 0
        for bad, why in (
            (moved, "its source is not the module's pinhole"),
            (tilted, "its detector is not perpendicular to the module's principal ray"),
            (behind, "its detector is not in front of the pinhole (see PinholeSystem.views)"),
        ):
            if bad.any():
                raise InputError(f"emission: view {int(np.argmax(bad))}: {why}")

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Rays from the pinhole through the grid, weighted with counts per (decay / (s mm^3) mm)."""
        k, d, l = self.system.principal_rays[m], self.system.pinhole_diameter[m], self.system.collimator_length[m]
        pinhole = views.sources[m]
        _, targets = (points.reshape(*views.shape, 3) for points in views.rays(m))
        scale = self._crystal_scale(views, m)
        from_crystal = scale * (targets - pinhole)  # from the pixel's place on the crystal to the pinhole
        cosine = l / np.linalg.norm(from_crystal, axis=-1)
        area = scale**2 * float(np.linalg.norm(np.cross(views.u_steps[m], views.v_steps[m])))
        weights = self.time * self.photons_per_decay * d**2 * area * cosine**4 / (16 * l**2)
        # To the plane through the grid's farthest corner.
        depth = max(float(((grid.corners() - pinhole) @ k).max()), l)
        yield Beam(np.broadcast_to(pinhole, targets.shape), pinhole + depth / l * from_crystal, weights)

    def _crystal_scale(self, views: Views, m: int) -> float:
        """A length on the crystal, per length on view m's plane."""
        distance = (views.detector_centers[m] - views.sources[m]) @ self.system.principal_rays[m]
        return float(self.system.collimator_length[m] / distance)
