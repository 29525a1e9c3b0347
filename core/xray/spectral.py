"""Polychromatic transmission: expected counts of a spectrum behind materials, and their derivatives by the paths."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..arrays import Array, ArrayLike, Floats
from ..errors import InputError
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..physics.crystal import gaussian_blur, point_blur
from ..physics.ct_numbers import CT_ENERGY
from ..physics.energy_window import FWHM_PER_SIGMA
from ..projector import Projector
from ..validation import all_above_0, at_least_0, freeze, instance, none_below_0, real_array
from ..volumes.volume import Volume, require_quantity
from .coefficients import attenuations
from .detectors import Bins, PanelDetector, PhotonCounter
from .spectra import Spectrum
from .system import XraySystem

_BINS = ((20.0, 60.0), (60.0, 120.0))
_RAYS = 8192  # number of rays computed at once
_METER = 1000.0  # mm


class SpectralTransmission:
    """Expected counts of X rays behind materials: ``sum over E of photons response exp(-sum mu path)``.

    Parameters
    ----------
    views
        `Views`, or a scanner that has them: counts are those of their pixels, with the pixels' areas and distances. None for
        single rays: counts are then those of 1 mm^2 at 1 m.
    spectrum
        The photons, such as a `tube_spectrum`, or its `coarser` form, which is faster.
    materials
        Names of `MATERIALS`, or elements such as "Cu".
    bins
        Lower and upper energies, keV; None for an `EnergyIntegrator`, whose single signal then stands for counts.
    detector
        A `PhotonCounter` or `EnergyIntegrator`. By default every photon is counted in the bin of its energy.
    blur
        FWHM on the panel, mm, one number or one for each view (M,), of the Gaussian blur of images by panel and focal spot,
        as `panel_blur` returns it. Counts blurred over an image's edge are lost.
    background
        Counts besides those of the spectrum, such as scatter: one number, or an array that broadcasts to (bins, M, n_v,
        n_u). Both are part of `images` and `project`, and blur of `volume_gradient`; single rays have none.

    Attributes
    ----------
    weights : array (bins, n)
        Expected counts in each bin from the photons of each energy, without attenuation, for 1 mm^2 at 1 m and 1 mAs.
    mu : array (materials, n)
        Attenuation coefficients, 1/mm.

    Raises
    ------
    InputError
        There is no such material, bins overlap or get no photons, or views are parallel.
    """

    def __init__(
        self,
        views: Views | Scanner | None,
        spectrum: Spectrum,
        materials: Sequence[str] = ("water", "bone"),
        bins: Bins | None = _BINS,
        detector: PanelDetector | None = None,
        blur: ArrayLike = 0.0,
        background: ArrayLike = 0.0,
    ) -> None:
        instance(spectrum, Spectrum, "spectrum")
        if not isinstance(views, Views | Scanner | None):
            raise InputError(f"views: expected Views, a scanner or None, got {type(views).__name__}")
        self.views = views.views() if isinstance(views, Scanner) else views
        self.spectrum = spectrum
        self.materials = (materials,) if isinstance(materials, str) else tuple(materials)
        if not self.materials or len(set(self.materials)) < len(self.materials):
            raise InputError(f"materials: expected one or more, each once, got {', '.join(self.materials) or 'none'}")
        self.bins = bins
        self.detector = PhotonCounter() if detector is None else detector
        weights = self.detector.response(spectrum.energies, bins) * spectrum.photons
        for i, row in enumerate(weights):
            if not row.any():
                raise InputError(f"bins: no photon reaches bin {i}: expected energies of the spectrum")
        self.weights = freeze(weights)
        self.mu = freeze(np.array([attenuations(name, spectrum.energies) for name in self.materials]))
        self._pixels = None if self.views is None else _pixel_factors(self.views)
        self._sigmas = _sigmas(self.views, none_below_0(blur, "blur")) if np.any(blur) else []
        self.background = freeze(none_below_0(background, "background"))

    def expected(self, paths: ArrayLike, mAs: ArrayLike) -> Floats:
        """Return the expected counts (bins, ...) of rays with `paths` (materials, ...), mm of each material.

        Each material has its own density. With views the paths are (materials, M, n_v, n_u), and `mAs` is a number or one
        for each view (M,).
        """
        array, scale = self._checked(paths, mAs)
        return self._sums(array, self.weights) * scale

    def jacobian(self, paths: ArrayLike, mAs: ArrayLike) -> Floats:
        """Return the derivatives (bins, materials, ...) of the expected counts by the paths, counts per mm."""
        array, scale = self._checked(paths, mAs)
        sums = self._sums(array, self._derivative_weights())
        return sums.reshape(len(self.weights), *array.shape) * scale

    def gradient(self, paths: ArrayLike, values: ArrayLike, mAs: ArrayLike) -> Floats:
        """Apply the adjoint of the `jacobian` to `values` (bins, ...); return (materials, ...)."""
        jacobian = self.jacobian(paths, mAs)
        values = real_array(values, "values", (len(self.weights), *jacobian.shape[2:]))
        return np.einsum("bm...,b...->m...", jacobian, values)

    def fisher(self, paths: ArrayLike, mAs: ArrayLike) -> Floats:
        """Return the Fisher information (materials, materials, ...) of Poisson counts about the paths, 1/mm^2.

        Its inverse is the smallest covariance of unbiased estimates of the paths.
        """
        jacobian = self.jacobian(paths, mAs)
        return np.einsum("bi...,bj...->ij...", jacobian, jacobian / self.expected(paths, mAs)[:, None])

    def project(self, volumes: Sequence[Volume | Array] | Array, A: Projector, mAs: ArrayLike) -> Floats:
        """Return the expected counts (bins, M, n_v, n_u) of material volumes, each relative to its material's own density.

        `A` is the `Projector` from the volumes' grid to these views; its line integrals of the volumes are the paths.
        """
        return self.images(self._paths(volumes, A), mAs, A)

    def images(self, paths: ArrayLike, mAs: ArrayLike, A: Projector | None = None) -> Floats:
        """Return expected counts (bins, M, n_v, n_u) for paths (materials, M, n_v, n_u), with blur and background.

        The paths are those to the pixels' centres, unless they are from a projector `A` that takes means over pixels.
        """
        counts = self.expected(paths, mAs)
        for m, (along_v, along_u) in enumerate(self._blurs(A)):
            counts[:, m] = along_v @ counts[:, m] @ along_u.T
        return counts + self.background

    def volume_gradient(
        self, volumes: Sequence[Volume | Array] | Array, values: ArrayLike, A: Projector, mAs: ArrayLike
    ) -> Array:
        """Apply the adjoint of the derivative of `project` by the volumes to `values`; return one volume per material.

        `values` are (bins, M, n_v, n_u).
        """
        values = np.array(values, np.float64)
        for m, (along_v, along_u) in enumerate(self._blurs(A)):
            values[:, m] = along_v.T @ values[:, m] @ along_u
        return np.stack([A.T(path) for path in self.gradient(self._paths(volumes, A), values, mAs)])

    def scale(self, shape: tuple[int, ...], mAs: ArrayLike) -> Floats:
        """Return the factor from `weights` to the counts of rays of a `shape`: mAs times pixel area and distance factor."""
        exposure = all_above_0(mAs, "mAs")
        if self._pixels is None:
            if exposure.ndim:
                raise InputError("mAs: expected one number where there are no views")
            return np.full(shape, float(exposure))
        if shape != self._pixels.shape:
            raise InputError(f"rays: expected those of the views, {self._pixels.shape}, got {shape}")
        if exposure.ndim and exposure.shape != (len(self._pixels),):
            raise InputError(f"mAs: expected one number, or {len(self._pixels)}, one for each view")
        return self._pixels * exposure.reshape(-1, 1, 1)

    def model(self, paths: Floats, scale: Floats) -> tuple[Floats, Floats]:
        """Return the counts (bins, N) of N rays and their derivatives (bins, materials, N) by the paths, counts per mm."""
        n = len(self.weights)
        sums = self._sums(paths, np.concatenate([self.weights, self._derivative_weights()])) * scale
        return sums[:n], sums[n:].reshape(n, *paths.shape)

    def _blurs(self, A: Projector | None) -> Iterator[tuple[Floats, Floats]]:
        """Yield, for each view, the matrices that blur its images of the paths of `A` along v and along u."""
        matrix = point_blur if getattr(getattr(A, "model", None), "pixel_points", 1) == 1 else gaussian_blur
        for v, u in self._sigmas:
            yield matrix(self.views.shape[0], v), matrix(self.views.shape[1], u)  # type: ignore[union-attr]

    def _derivative_weights(self) -> Floats:
        """Return the weights (bins * materials, n) of the derivatives by the paths: ``-mu weights``."""
        return (-self.weights[:, None] * self.mu).reshape(-1, self.mu.shape[1])

    def _sums(self, paths: Floats, weights: Floats) -> Floats:
        """Return, for each row of `weights`, the sum over energies of weight times transmittance, (rows, ...)."""
        rays = paths.reshape(len(paths), -1)
        sums = np.empty((len(weights), rays.shape[1]))
        for start in range(0, rays.shape[1], _RAYS):
            batch = slice(start, start + _RAYS)
            sums[:, batch] = weights @ np.exp(-(self.mu.T @ rays[:, batch]))
        return sums.reshape(len(weights), *paths.shape[1:])

    def _checked(self, paths: ArrayLike, mAs: ArrayLike) -> tuple[Floats, Floats]:
        """Return the paths as an array, and the factor from `weights` to the counts of their rays."""
        array = real_array(paths, "paths", None)
        if not array.ndim or len(array) != len(self.materials):
            expected = f"first axis of {len(self.materials)}, {', '.join(self.materials)}"
            raise InputError(f"paths: expected a {expected}; got shape {array.shape}")
        return array, self.scale(array.shape[1:], mAs)

    def _paths(self, volumes: Sequence[Volume | Array] | Array, A: Projector) -> Floats:
        """Return the line integrals (materials, M, n_v, n_u) of material volumes, mm."""
        if len(volumes) != len(self.materials):
            expected = f"{len(self.materials)}, {', '.join(self.materials)}"
            raise InputError(f"volumes: expected {expected}; got {len(volumes)}")
        arrays = (volume.array if isinstance(volume, Volume) else volume for volume in volumes)
        return np.stack([np.asarray(A(array), np.float64) for array in arrays])


def panel_blur(system: XraySystem, fwhm: float = 0.0) -> Floats:
    """Return the blur of images of objects at the isocentre, FWHM on the panel (N,), mm: of panel and focal spots together.

    A focal spot's shadow is its size times the panel's distance behind the isocentre, divided by the source's distance in
    front of it; a uniform shadow blurs like the Gaussian of the same variance. `fwhm` is the panel's own blur, mm.
    """
    instance(system, XraySystem, "panel_blur")
    distances = np.linalg.norm(system.sources, axis=1)
    shadow = system.focal_spot * (np.linalg.norm(system.panel_centers - system.sources, axis=1) / distances - 1)
    return np.hypot(at_least_0(fwhm, "fwhm"), np.maximum(shadow, 0) * FWHM_PER_SIGMA / math.sqrt(12))


def _sigmas(views: Views | None, blur: Floats) -> list[tuple[float, float]]:
    """Return, for each view, the standard deviations of its blur along v and along u, pixels."""
    if views is None or blur.shape not in ((), (len(views),)):
        raise InputError("blur: expected one number, or one of each view, and views")
    steps = np.linalg.norm([views.v_steps, views.u_steps], axis=2)
    return list(zip(*(blur / FWHM_PER_SIGMA / steps).tolist(), strict=True))


def _pixel_factors(views: Views) -> Floats:
    """Return the solid angle of each pixel (M, n_v, n_u) in units of that of 1 mm^2 at 1 m."""
    views.require_pinholes("spectral transmission")
    areas = np.cross(views.u_steps, views.v_steps)
    factors = np.empty((len(views), *views.shape))
    for m, area in enumerate(areas):
        sources, targets = views.rays(m)
        rays = targets - sources
        factors[m] = (np.abs(rays @ area) * _METER**2 / np.linalg.norm(rays, axis=1) ** 3).reshape(views.shape)
    return factors


def water_and_bone(volume: Volume, energy: float = CT_ENERGY) -> Floats:
    """Return volumes of water and cortical bone (2, n_x, n_y, n_z) from CT numbers, or from mu, 1/mm.

    Both are relative to the materials' own densities. `energy`, keV, is that at which mu holds, or the CT's. The mixture
    attenuates as `hu_to_mu` does at every energy, except for air's own coefficient: below 0 HU water becomes thinner, above
    it is replaced by bone. Voxels denser than bone are bone alone, with the density that their value requires at this
    energy.
    """
    instance(volume, Volume, "water_and_bone")
    require_quantity(volume.quantity, ("hu", "mu"), "water_and_bone")
    water_mu, bone_mu = (float(attenuations(name, np.array([energy]))[0]) for name in ("water", "bone"))
    values = volume.array.astype(np.float64)
    hu = values / 1000 if volume.quantity == "hu" else values / water_mu - 1  # CT numbers by 1000
    bone_share = np.maximum(hu, 0) * water_mu / (bone_mu - water_mu)
    result = np.stack([1 + np.clip(hu, -1, 0) - bone_share, bone_share])
    is_denser = bone_share > 1
    result[:, is_denser] = np.stack([0 * hu[is_denser], (1 + hu[is_denser]) * water_mu / bone_mu])
    return result
