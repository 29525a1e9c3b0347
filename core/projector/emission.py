"""SPECT: how many photons a pixel of the crystal counts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..checks import positive, real_array
from ..errors import InputError
from ..grid import Grid
from ..system import PinholeSystem
from ..views import Views
from ..volume import Volume
from .arrays import is_tensor
from .models import Array, Beam, Model, view_rays
from .rays import Fan

# Views may differ from the system they are said to be of by a file's rounding (mm; sine of an angle).
_SAME_PLACE = 1e-3
_SAME_DIRECTION = 1e-6

_FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True, eq=False)
class Emission(Model):
    """Expected counts per pixel of a volume of activity (kBq/mL, which is decays per s and mm^3).

    A ray of the pixel that leaves the pinhole at an angle psi to the principal ray counts ::

        time * d_e^2 p_u p_v cos^4(psi) / (16 l^2) * efficiency * integral of f exp(-integral of mu) dr

    with p the pixel pitch on the crystal (of a virtual detector's pixel: its image there), d_e the pinhole's
    effective diameter and l the collimator's length. Summed over the pixels that is the law of a point source at
    height h above the pinhole's plane, seen at elevation theta: ``g = d_e^2 sin^3(theta) / (16 h^2)``. The 1/r^2 of
    that law is in the density of the rays. The rays run from the pinhole through the whole grid, wherever a virtual
    detector stands. By default the pinhole is ideal: nothing attenuates, penetrates, blurs or is missed.

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
        Photons of the energy that is counted, per decay (`core.isotopes`).
    aperture_points : int
        Points of the hole's disk from which rays start, each counting the same: the blur of a hole of diameter d_e.
        With 1 all rays pass the middle, and the hole blurs nothing; else at least 3.
    aperture_mu : float, optional
        Attenuation coefficient of the aperture's material, 1/mm (`core.isotopes.TUNGSTEN_MU`). None: nothing
        penetrates it, d_e = d.
    opening_angle : float
        Full angle alpha of the knife edge's cone, rad. With `aperture_mu`, ``d_e^2 = d (d + 2 / mu tan(alpha / 2))``
        (Paix 1967).
    crystal_mu : float, optional
        Attenuation coefficient of the crystal, 1/mm (`core.isotopes.NAI_MU`, `CZT_MU`). With it
        ``1 - exp(-crystal_mu Td / cos(psi))`` of the photons are counted. None: all.
    intrinsic_fwhm : float
        Of the detector's Gaussian blur, mm on the crystal. What is blurred over the image's edge is lost.
    within_crystal : bool
        Whether pixels, or the parts of them, beyond the crystal's side Ld count nothing.

    Raises
    ------
    InputError
        An argument is of another kind or out of its range.

    References
    ----------
    D. Paix, "Pinhole imaging of gamma rays", Physics in Medicine and Biology 12 (1967) 489-500.
    """

    system: PinholeSystem
    mu: Volume | None = None
    time: float = 1.0
    photons_per_decay: float = 1.0
    aperture_points: int = 1
    aperture_mu: float | None = None
    opening_angle: float = math.pi / 2
    crystal_mu: float | None = None
    intrinsic_fwhm: float = 0.0
    within_crystal: bool = False

    name = "emission"

    def __post_init__(self) -> None:
        if not isinstance(self.system, PinholeSystem):
            raise InputError(f"emission: expected a PinholeSystem, got {type(self.system).__name__}")
        if self.mu is not None:
            if not isinstance(self.mu, Volume):
                hint = ": there are no gradients with respect to mu" if is_tensor(self.mu) else ""
                raise InputError(f"emission: expected mu to be a Volume, got {type(self.mu).__name__}{hint}")
            if self.mu.quantity != "mu":
                raise InputError(f"emission: expected a volume of mu, got {self.mu.quantity}")
            if self.mu.array.min() < 0:
                raise InputError(f"emission: mu must not be negative, got {self.mu.array.min():g} 1/mm")
        for name in ("time", "photons_per_decay", "aperture_mu", "opening_angle", "crystal_mu"):
            if getattr(self, name) is not None or name not in ("aperture_mu", "crystal_mu"):
                object.__setattr__(self, name, positive(getattr(self, name), f"emission: {name}"))
        if self.opening_angle >= math.pi:
            raise InputError(f"emission: opening_angle must be below pi, got {self.opening_angle:g} rad")
        fwhm = float(real_array(self.intrinsic_fwhm, "emission: intrinsic_fwhm", ()))
        object.__setattr__(self, "intrinsic_fwhm", fwhm)
        if fwhm < 0:
            raise InputError(f"emission: intrinsic_fwhm must not be negative, got {fwhm:g} mm")
        n = self.aperture_points
        if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1 or n == 2:
            raise InputError(f"emission: aperture_points: expected 1, 3 or more, got {n!r}")
        object.__setattr__(self, "aperture_points", int(n))
        object.__setattr__(self, "within_crystal", bool(self.within_crystal))

    def record(self) -> dict[str, Any]:
        """The settings, for a run's record; of mu only its grid."""
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("system", "mu")}
        if self.mu is not None:
            settings["mu"] = {"shape": list(self.mu.grid.shape), "affine": self.mu.grid.affine.tolist()}
        return settings

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
        u, v, k = self.system.frames().transpose(1, 0, 2)
        moved = np.linalg.norm(views.sources - self.system.centers, axis=1) > _SAME_PLACE
        turned = np.zeros(len(views), dtype=bool)
        for steps, axis in ((views.u_steps, u), (views.v_steps, v)):
            sine = np.linalg.norm(np.cross(steps, axis), axis=1) / np.linalg.norm(steps, axis=1)
            turned |= sine > _SAME_DIRECTION
        behind = np.einsum("mi,mi->m", views.detector_centers - views.sources, k) <= 0
        for bad, why in (
            (moved, "its source is not the module's pinhole"),
            (turned, "its pixels do not lie along the module's u and v"),
            (behind, "its detector is not in front of the pinhole (see PinholeSystem.views)"),
        ):
            if bad.any():
                raise InputError(f"emission: view {int(np.argmax(bad))}: {why}")

    @property
    def effective_diameter(self) -> Array:
        """d_e (M,), mm: the opaque hole that lets as many photons pass (Paix)."""
        d = self.system.pinhole_diameter
        if self.aperture_mu is None:
            return d
        return np.sqrt(d * (d + 2 / self.aperture_mu * math.tan(self.opening_angle / 2)))

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Rays from the pinhole through the grid, weighted with counts per (decay / (s mm^3) mm)."""
        u, v, k = self.system.frames()[m]
        l, diameter = self.system.collimator_length[m], self.effective_diameter[m]
        pinhole, rays, scale = views.sources[m], view_rays(views, m), self._crystal_scale(views, m)
        # The pixels' places on the crystal, mm along u and v, point-inverted, seen from its middle.
        middle = scale * (rays.corner - pinhole)
        pitch_u, pitch_v = self._crystal_pitch(views, m)
        n_v, n_u = views.shape
        along_v = (middle @ v + scale * (rays.line_step @ v) * np.arange(n_v))[:, None]
        along_u = (middle @ u + scale * (rays.ray_step @ u) * np.arange(n_u))[None, :]
        counts = self.time * self.photons_per_decay * diameter**2 * pitch_u * pitch_v / (16 * l**2)
        if self.within_crystal:
            counts = counts * self._share_on_crystal(m, along_v, pitch_v)
            counts = counts * self._share_on_crystal(m, along_u, pitch_u)
        # To the plane through the grid's farthest corner.
        depth = max(float(((grid.corners() - pinhole) @ k).max()), l)
        for x, y in diameter / 2 * disk_points(self.aperture_points):
            point = x * u + y * v
            cosine = l / np.sqrt((along_u + x) ** 2 + (along_v + y) ** 2 + l**2)
            weights = counts / self.aperture_points * cosine**4
            if self.crystal_mu is not None:
                weights *= -np.expm1(-self.crystal_mu * self.system.detector_thickness[m] / cosine)
            source, stretch = pinhole + point, depth / l * scale
            corner = source + depth / l * (middle + point)
            fan = Fan(source, corner, stretch * rays.line_step, stretch * rays.ray_step, views.shape)
            yield Beam(fan, weights)

    def response(self, views: Views, m: int) -> tuple[Array, Array] | None:
        """The intrinsic blur of view m: matrices (n_v, n_v) along v and (n_u, n_u) along u."""
        if self.intrinsic_fwhm == 0:
            return None
        sigma = self.intrinsic_fwhm / _FWHM_PER_SIGMA
        pitch_u, pitch_v = self._crystal_pitch(views, m)
        n_v, n_u = views.shape
        return gaussian_blur(n_v, sigma / pitch_v), gaussian_blur(n_u, sigma / pitch_u)

    def _crystal_scale(self, views: Views, m: int) -> float:
        """A length on the crystal, per length on view m's plane."""
        distance = (views.detector_centers[m] - views.sources[m]) @ self.system.principal_rays[m]
        return float(self.system.collimator_length[m] / distance)

    def _crystal_pitch(self, views: Views, m: int) -> tuple[float, float]:
        """Size of a pixel on the crystal, mm along u and v."""
        scale = self._crystal_scale(views, m)
        return scale * float(np.linalg.norm(views.u_steps[m])), scale * float(np.linalg.norm(views.v_steps[m]))

    def _share_on_crystal(self, m: int, middle: Array, pitch: float) -> Array:
        """Shares of pixels of size `pitch` around `middle` (mm from the crystal's middle, along one side) on the crystal."""
        half = self.system.detector_side[m] / 2
        overlap = np.minimum(middle + pitch / 2, half) - np.maximum(middle - pitch / 2, -half)
        return np.clip(overlap, 0, None) / pitch


def disk_points(n: int) -> Array:
    """n points (n, 2) that stand for equal parts of the unit disk: Vogel's spiral, as in the head of a sunflower.

    Shifted and stretched a little, so that their mean is the disk's, 0, and their variance too, 1/4 along every
    direction: the blur has the right width however few the points. 1 point is the middle; 2 have no such variance.

    References
    ----------
    H. Vogel, "A better way to construct the sunflower head", Mathematical Biosciences 44 (1979) 179-189.
    """
    if n == 1:
        return np.zeros((1, 2))
    i = np.arange(n)
    radius = np.sqrt((i + 0.5) / n)[:, None]
    points = radius * np.stack([np.cos(i * _GOLDEN_ANGLE), np.sin(i * _GOLDEN_ANGLE)], axis=1)
    points -= points.mean(axis=0)
    spread = np.linalg.cholesky(points.T @ points / n)
    return points @ np.linalg.inv(spread).T / 2


def gaussian_blur(n: int, sigma: float) -> NDArray[np.float64]:
    """Matrix (n, n) that blurs n pixels with a Gaussian of `sigma` pixels, integrated over the receiving pixel."""
    edges = (np.arange(n + 1) - 0.5) / (sigma * math.sqrt(2))
    kernel = np.diff([0.5 * math.erf(x) for x in edges])
    distance = np.abs(np.arange(n)[:, None] - np.arange(n))
    return kernel[distance]
