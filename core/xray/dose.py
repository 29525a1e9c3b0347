"""Absorbed dose of an activity: electrons at their place of emission, photons by a point kernel of water."""

import math
from collections.abc import Callable

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..geometry.grid import Grid
from ..memory import require
from ..physics.isotopes import isotope as isotope_of
from ..progress import Progress, tell
from ..validation import all_above_0, freeze, instance, one_of, positive
from ..volumes.volume import Volume, require_quantity
from .coefficients import energy_absorption, interpolate_log, photon_data
from .spectra import tube_spectrum
from .system import XraySystem, filter_thicknesses

PHOTONS = ("build-up", "straight", "none")
"""Models of the photons' dose, described at `absorbed_dose_rate`."""

_MGY_PER_HOUR = 1.602176634e-16 * 1e3 * 3600 * 1e6
"""Dose rate, mGy/h, of 1 keV/s in each milligram: J per keV, mGy per Gy, s per h, mg per kg."""

_NEAR = 2  # distance in voxels up to which kernels are averaged over both voxels
_DIRECTIONS = 2000  # directions of the self-dose integral
_NODES = 20  # Gauss-Legendre nodes along each direction

RadialKernel = Callable[[Floats], Floats]
"""A function of distances r, mm: ``4 pi r^2`` times a point kernel."""


def absorbed_dose_rate(
    activity: Volume,
    isotope: str,
    density: ArrayLike | None = None,
    photons: str = "build-up",
    progress: Progress | None = None,
) -> Volume:
    """Compute the absorbed dose rate, mGy/h, of an activity.

    Electrons are absorbed in the voxel of the decay: right for voxels larger than their range, 2 mm for Lu-177 and I-131.
    Photons are absorbed as if water were everywhere, also beyond the body's surface, which overstates the dose near it; the
    kernel is averaged over voxels that are near each other.

    Parameters
    ----------
    activity
        kBq/mL; 0 outside its grid.
    isotope
        A name of `ISOTOPES`, with energies per decay of ICRP Publication 107.
    density
        Densities, g/cm^3: a number, or an array on the activity's grid; 1 by default. Electrons are absorbed in the mass of
        their voxel. For photons the water has a single density, the mass-weighted mean ``sum(density^2) / sum(density)``.
    photons
        "build-up": ``E mu_en / rho B(mu r) exp(-mu r) / (4 pi r^2)`` with the build-up factors of ANSI/ANS-6.4.3 for a
        point source in water, scaled so that water without end absorbs all of the energy.
        "straight": ``B = 1`` and mu_en for mu, so that photons lose energy along straight lines; for comparison with closed
        forms. "none": electrons alone.
    progress
        Called while the kernel is computed, which takes most of the time.

    Returns
    -------
    Volume
        On the activity's grid, with quantity "dose_rate".

    Raises
    ------
    InputError
        The quantity is another one, the activity is negative, the isotope is unknown, or a density is 0 or less.
    """
    instance(activity, Volume, "absorbed_dose_rate")
    require_quantity(activity.quantity, ("activity",), "absorbed_dose_rate")
    nuclide, grid = isotope_of(isotope), activity.grid
    one_of(photons, PHOTONS, "photons")
    decays_per_s = activity.array.astype(np.float64)  # in each mm^3; 1 kBq/mL is 1 Bq/mm^3
    if decays_per_s.min() < 0:
        raise InputError(f"absorbed_dose_rate: expected activity of 0 or more, got {decays_per_s.min():g}")
    mass = _densities(density, grid)  # mg/mm^3
    local = nuclide.electrons + (0 if photons == "none" else nuclide.soft_photons)
    rate = decays_per_s * local / mass
    if photons != "none":
        rho = float((mass**2).sum() / mass.sum())
        lines = nuclide.lines + nuclide.weak_lines
        kernel = voxel_kernel(grid, lambda r: line_kernel(lines, rho, r, photons == "build-up"), progress)
        rate += convolve(decays_per_s * grid.voxel_volume, kernel)
    return Volume(np.asarray(rate * _MGY_PER_HOUR, np.float32), grid, "dose_rate")


def absorbed_dose(
    rate: Volume, isotope: str, biological_half_life: float | None = None, duration: float | None = None
) -> Volume:
    """Integrate a dose rate that falls with the effective half-life; return the absorbed dose, mGy.

    Decay rates add: ``1 / T_effective = 1 / T_physical + 1 / T_biological``.

    Parameters
    ----------
    rate
        Initial dose rate, mGy/h, as from `absorbed_dose_rate`.
    isotope
        A name of `ISOTOPES`, for the physical half-life.
    biological_half_life
        Hours; None without biological elimination.
    duration
        Hours; None for an infinite time.
    """
    instance(rate, Volume, "absorbed_dose")
    require_quantity(rate.quantity, ("dose_rate",), "absorbed_dose")
    per_hour = math.log(2) * 3600 / isotope_of(isotope).half_life
    if biological_half_life is not None:
        per_hour += math.log(2) / positive(biological_half_life, "biological_half_life", "h")
    share = 1.0 if duration is None else -math.expm1(-per_hour * positive(duration, "duration", "h"))
    return Volume(rate.array * np.float32(share / per_hour), rate.grid, "dose")


def isocentre_kerma(system: XraySystem) -> Floats:
    """Return the air kerma at the isocentre, µGy, of each source's exposure (N,), without a body; their sum is a scan's.

    It follows from the sources' kVp, mAs, filters and distances, for tubes of `tube_spectrum`, without absorption in air.
    """
    instance(system, XraySystem, "isocentre_kerma")
    tubes = zip(system.kvp.tolist(), system.filters.tolist(), strict=True)
    kerma_per_mas = np.array([tube_spectrum(kvp, filter_thicknesses(text)).kerma for kvp, text in tubes])
    return kerma_per_mas * system.mas * 1e6 / np.sum(system.sources**2, axis=1)


def line_kernel(lines: tuple[tuple[float, float], ...], density: float, r: Floats, build_up: bool) -> Floats:
    """Return ``4 pi r^2`` times the point kernel of all photon lines of a decay, at distances r, mm: keV/mg mm^2.

    `density` is the water's, mg/mm^3. Without `build_up` photons lose their energy along straight lines.
    """
    total = np.zeros(r.shape)
    energies = np.array([energy for energy, _ in lines])
    absorption = energy_absorption("water", energies) / 10  # mm^2/mg
    attenuation = interpolate_log(energies, *photon_data()[[0, 3]]) / 10 if build_up else absorption
    for (energy, photons), absorbed, mu in zip(lines, absorption, density * attenuation, strict=True):
        factor = _absorption_build_up(energy, mu * r, density * absorbed / mu) if build_up else 1.0
        total += photons * energy * absorbed * factor * np.exp(-mu * r)
    return total


def _absorption_build_up(energy: float, depths: Floats, absorbed_share: float) -> Floats:
    """Return build-up factors B of absorbed energy: those of exposure, scaled to ``integral of B exp(-x) dx = mu / mu_en``.

    So an endless medium absorbs all of the energy. Air absorbs relatively more of scattered photons than water, so that
    exposure's factors less 1 are up to 5 % too large. `absorbed_share` is mu_en / mu.
    """
    nodes, weights = np.polynomial.laguerre.laggauss(40)  # type: ignore[no-untyped-call]
    scattered = weights @ (build_up_factor(energy, nodes) - 1)
    return 1 + (1 / absorbed_share - 1) / scattered * (build_up_factor(energy, depths) - 1)


def build_up_factor(energy: float, depths: Floats) -> Floats:
    """Return water's build-up factors at depths of up to 40 mean free paths: ANSI/ANS-6.4.3, geometric progression."""
    table = photon_data()
    b, c, a, X, d = (np.interp(math.log(energy), np.log(table[0]), row) for row in table[4:])
    x = np.clip(depths, 1e-9, 40.0)
    k = c * x**a + d * (np.tanh(x / X - 2) - math.tanh(-2)) / (1 - math.tanh(-2))
    near_1 = np.abs(k - 1) < 1e-6
    growth = np.where(near_1, x, np.expm1(x * np.log(np.maximum(k, 1e-9))) / np.where(near_1, 1, k - 1))
    return 1 + (b - 1) * growth


def voxel_kernel(grid: Grid, radial: RadialKernel, progress: Progress | None = None) -> Floats:
    """Return the mean kernel between the points of two voxels, for all offsets between voxels along each axis.

    `radial` is ``4 pi r^2`` times the point kernel at r, mm. The array is (2 n_x, 2 n_y, 2 n_z), wrapped: index -1 is offset
    -1.
    """
    require(8.0 * 8 * 4 * grid.n_voxels, "the kernel of the dose")
    linear = grid.affine[:3, :3]
    max_distance = float(np.linalg.norm(np.abs(linear) @ (2 * np.array(grid.shape))))
    distances = np.concatenate([[0.0], np.geomspace(1e-3 * grid.spacing.min(), max_distance, 4000)])
    values = radial(distances)

    def point_kernel(offsets: Floats) -> Floats:
        """Return the point kernel at offsets (..., 3) in voxels."""
        r2 = np.sum((offsets @ linear.T) ** 2, axis=-1)
        return np.interp(np.sqrt(r2), distances, values) / (4 * math.pi * r2)

    axes = [np.fft.fftfreq(2 * n, 1 / (2 * n)) for n in grid.shape]
    kernel = np.empty([2 * n for n in grid.shape])
    with np.errstate(divide="ignore"):
        for i, x in enumerate(axes[0]):
            tell(progress, i, len(axes[0]))
            kernel[i] = point_kernel(np.stack(np.broadcast_arrays(x, axes[1][:, None], axes[2]), axis=-1))
    differences, weights = _point_differences()
    near = [range(-min(_NEAR, n - 1), min(_NEAR, n - 1) + 1) for n in grid.shape]
    for offset in np.array(np.meshgrid(*near, indexing="ij")).reshape(3, -1).T:
        kernel[tuple(offset)] = weights @ point_kernel(offset + differences)
    kernel[0, 0, 0] = _self_kernel(linear, lambda r: np.interp(r, distances, values))
    return kernel


def _point_differences(n: int = 10) -> tuple[Floats, Floats]:
    """Return differences (n^3, 3) between two points of a voxel, in voxels, and their weights, which sum to 1."""
    x = (np.arange(n) + 0.5) / n * 2 - 1
    frequency = 1 - np.abs(x)
    frequency /= frequency.sum()
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    return points, np.einsum("i,j,k->ijk", frequency, frequency, frequency).ravel()


def _self_kernel(linear: Floats, radial: RadialKernel) -> float:
    """Return the mean of the kernel between two points of the same voxel.

    The integral is in polar coordinates, where the kernel's pole at distance 0 cancels. `linear` (3, 3) leads from voxels to
    mm.
    """
    z = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
    azimuth = math.pi * (1 + math.sqrt(5)) * np.arange(_DIRECTIONS)
    sine = np.sqrt(1 - z**2)
    directions = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], axis=1)  # in voxels
    max_length = 1 / np.abs(directions).max(axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)  # type: ignore[no-untyped-call]
    lengths = max_length[:, None] * (nodes + 1) / 2
    overlap = np.prod(1 - np.abs(lengths[..., None] * directions[:, None]), axis=-1)
    mm_per_voxel = np.linalg.norm(directions @ linear.T, axis=1)[:, None]  # mm of one voxel in each direction
    radial_mean = (overlap * radial(lengths * mm_per_voxel) / mm_per_voxel**2) @ weights * max_length / 2
    return float(radial_mean.mean())


def convolve(values: Floats, kernel: Floats) -> Floats:
    """Convolve `values` with a wrapped kernel that is twice as long along each axis, by FFT."""
    axes, sizes = (0, 1, 2), kernel.shape
    product = np.fft.rfftn(values, sizes, axes) * np.fft.rfftn(kernel, sizes, axes)
    return np.fft.irfftn(product, sizes, axes)[tuple(slice(n) for n in values.shape)]


def _densities(density: ArrayLike | None, grid: Grid) -> Floats:
    """Return densities, g/cm^3, on the grid; raise `InputError` for another shape or values that are not above 0."""
    values = all_above_0(1.0 if density is None else density, "density", unit="g/cm^3")
    if values.shape not in ((), grid.shape):
        raise InputError(f"density: expected one number or an array of {grid.shape}, got {values.shape}")
    return freeze(np.broadcast_to(values, grid.shape).copy())
