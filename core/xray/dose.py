"""Absorbed dose of activity in the body: electrons where they are set free, photons by a point kernel of water."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..geometry.grid import Grid
from ..memory import require
from ..physics.isotopes import isotope as isotope_of
from ..progress import Progress, tell
from ..validation import all_above_0, freeze, instance, one_of, positive
from ..volumes.volume import Volume, require_quantity
from .coefficients import between, energy_absorption, photon_data, table_lines
from .spectra import tube_spectrum
from .system import XraySystem, filter_thicknesses

PHOTONS = ("build-up", "straight", "none")
"""How photons are counted: see `absorbed_dose_rate`."""

_MGY_PER_HOUR = 1.602176634e-16 * 1e3 * 3600 * 1e6
"""mGy/h of 1 keV/s in each milligram: J per keV, mGy per Gy, s per h, mg per kg."""

_NEAR = 2  # voxels apart, up to which kernels are averaged over both voxels
_DIRECTIONS = 2000
_NODES = 20

Radial = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Decay:
    """Energy that one decay sets free, by ICRP Publication 107."""

    electrons: float  # keV
    soft_photons: float  # keV of photons below 10 keV, which are absorbed where they are set free
    lines: tuple[tuple[float, float], ...]  # energy, keV, and photons per decay


@cache
def decays() -> dict[str, Decay]:
    """The isotopes of decays.txt by name."""
    found = {}
    for name, *numbers in map(str.split, table_lines("decays.txt")):
        electrons, soft, *lines = map(float, numbers)
        found[name] = Decay(electrons, soft, tuple(zip(lines[::2], lines[1::2], strict=True)))
    return found


def absorbed_dose_rate(
    activity: Volume,
    isotope: str,
    density: ArrayLike | None = None,
    photons: str = "build-up",
    progress: Progress | None = None,
) -> Volume:
    """Absorbed dose rate, mGy/h, of an activity.

    Electrons are absorbed in the voxel that sets them free: right for voxels larger than their range, 2 mm for Lu-177 and
    I-131. Photons are absorbed around it as in water everywhere, also beyond the body's surface, which overstates the dose
    near it; the kernel is averaged over voxels that are near each other.

    Parameters
    ----------
    activity
        kBq/mL. Outside its grid there is none.
    isotope
        "Tc-99m", "I-123", "I-131" or "Lu-177": energies per decay of ICRP Publication 107.
    density
        Densities, g/cm^3: a number, or an array on the activity's grid; 1 by default. Electrons are absorbed in each
        voxel's own mass. For photons the water has one density, that of the mean mass: ``sum(density^2) / sum(density)``.
    photons
        "build-up": ``E mu_en / rho B(mu r) exp(-mu r) / (4 pi r^2)`` with the build-up factors of ANSI/ANS-6.4.3 for a
        point source in water. "straight": ``B = 1`` and mu_en for mu, so that photons lose energy along straight lines;
        for comparison with closed forms. "none": electrons alone.
    progress
        Called while the kernel is made, which takes most of the time.

    Returns
    -------
    Volume
        On the activity's grid, with quantity "dose_rate".

    Raises
    ------
    InputError
        Another quantity, negative activity, no such isotope, a density of 0 or less.
    """
    instance(activity, Volume, "absorbed_dose_rate")
    require_quantity(activity.quantity, ("activity",), "absorbed_dose_rate")
    one_of(isotope, decays(), "isotope")
    one_of(photons, PHOTONS, "photons")
    decay, grid = decays()[isotope], activity.grid
    decays_per_s = activity.array.astype(np.float64)  # of each mm^3: kBq/mL
    if decays_per_s.min() < 0:
        raise InputError(f"absorbed_dose_rate: expected activity of 0 or more, got {decays_per_s.min():g}")
    mass = _densities(density, grid)  # mg of each mm^3
    local = decay.electrons + (0 if photons == "none" else decay.soft_photons)
    rate = decays_per_s * local / mass
    if photons != "none":
        rho = float((mass**2).sum() / mass.sum())
        kernel = voxel_kernel(grid, lambda r: sum_of_lines(decay.lines, rho, r, photons == "build-up"), progress)
        rate += convolved(decays_per_s * grid.voxel_volume, kernel)
    return Volume(np.asarray(rate * _MGY_PER_HOUR, np.float32), grid, "dose_rate")


def absorbed_dose(
    rate: Volume, isotope: str, biological_half_life: float | None = None, duration: float | None = None
) -> Volume:
    """Absorbed dose, mGy, of a dose rate that falls with the effective half-life.

    Rates of decay add: ``1 / T_effective = 1 / T_physical + 1 / T_biological``.

    Parameters
    ----------
    rate
        The rate at the beginning, mGy/h, as of `absorbed_dose_rate`.
    isotope
        A name of `ISOTOPES`, for the physical half-life.
    biological_half_life
        Hours; None where nothing is washed out.
    duration
        Hours; None for ever.
    """
    instance(rate, Volume, "absorbed_dose")
    require_quantity(rate.quantity, ("dose_rate",), "absorbed_dose")
    per_hour = math.log(2) * 3600 / isotope_of(isotope).half_life
    if biological_half_life is not None:
        per_hour += math.log(2) / positive(biological_half_life, "biological_half_life", "h")
    share = 1.0 if duration is None else -math.expm1(-per_hour * positive(duration, "duration", "h"))
    return Volume(rate.array * np.float32(share / per_hour), rate.grid, "dose")


def isocentre_kerma(system: XraySystem) -> Floats:
    """Air kerma at the isocentre, µGy, of each source's exposure (N,), without a body; their sum is a scan's.

    By the sources' kVp, mAs, filters and distances, for tubes of `tube_spectrum`; nothing is absorbed in air.
    """
    instance(system, XraySystem, "isocentre_kerma")
    kinds = zip(system.kvp.tolist(), system.filters.tolist(), strict=True)
    of_each = np.array([tube_spectrum(kvp, filter_thicknesses(text)).kerma for kvp, text in kinds])
    return of_each * system.mas * 1e6 / np.sum(system.sources**2, axis=1)


def sum_of_lines(lines: tuple[tuple[float, float], ...], density: float, r: Floats, build_up: bool) -> Floats:
    """``4 pi r^2`` times what a decay's photons give to water at distances r, mm: keV/mg mm^2, of all lines."""
    total = np.zeros(r.shape)
    energies = np.array([energy for energy, _ in lines])
    absorption = energy_absorption("water", energies) / 10  # mm^2/mg
    attenuation = between(energies, *photon_data()[[0, 3]]) / 10 if build_up else absorption
    for (energy, photons), absorbed, mu in zip(lines, absorption, density * attenuation, strict=True):
        factor = build_up_factor(energy, mu * r) if build_up else 1.0
        total += photons * energy * absorbed * factor * np.exp(-mu * r)
    return total


def build_up_factor(energy: float, depths: Floats) -> Floats:
    """Build-up factors of water at depths, in mean free paths, up to 40: ANSI/ANS-6.4.3, geometric progression."""
    table = photon_data()
    b, c, a, X, d = (np.interp(math.log(energy), np.log(table[0]), row) for row in table[4:])
    x = np.clip(depths, 1e-9, 40.0)
    k = c * x**a + d * (np.tanh(x / X - 2) - math.tanh(-2)) / (1 - math.tanh(-2))
    near_1 = np.abs(k - 1) < 1e-6
    growth = np.where(near_1, x, np.expm1(x * np.log(np.maximum(k, 1e-9))) / np.where(near_1, 1, k - 1))
    return 1 + (b - 1) * growth


def voxel_kernel(grid: Grid, radial: Radial, progress: Progress | None = None) -> Floats:
    """The mean in one voxel of what a point somewhere in another gives: for offsets around 0 along each axis, wrapped.

    `radial` is ``4 pi r^2`` times the point kernel at r, mm. The array is (2 n_x, 2 n_y, 2 n_z); index -1 is offset -1.
    """
    require(8.0 * 8 * 4 * grid.n_voxels, "the kernel of the dose")
    linear = grid.affine[:3, :3]
    longest = float(np.linalg.norm(np.abs(linear) @ (2 * np.array(grid.shape))))
    known = np.concatenate([[0.0], np.geomspace(1e-3 * grid.spacing.min(), longest, 4000)])
    values = radial(known)

    def at(offsets: Floats) -> Floats:
        r2 = np.sum((offsets @ linear.T) ** 2, axis=-1)
        return np.interp(np.sqrt(r2), known, values) / (4 * math.pi * r2)

    axes = [np.fft.fftfreq(2 * n, 1 / (2 * n)) for n in grid.shape]
    kernel = np.empty([2 * n for n in grid.shape])
    with np.errstate(divide="ignore"):
        for i, x in enumerate(axes[0]):
            tell(progress, i, len(axes[0]))
            kernel[i] = at(np.stack(np.broadcast_arrays(x, axes[1][:, None], axes[2]), axis=-1))
    inside, weights = _differences()
    reach = [range(-min(_NEAR, n - 1), min(_NEAR, n - 1) + 1) for n in grid.shape]
    for offset in np.array(np.meshgrid(*reach, indexing="ij")).reshape(3, -1).T:
        kernel[tuple(offset)] = weights @ at(offset + inside)
    kernel[0, 0, 0] = _self_kernel(linear, lambda r: np.interp(r, known, values))
    return kernel


def _differences(n: int = 10) -> tuple[Floats, Floats]:
    """Differences (n^3, 3) between two points of a voxel, in voxels, and how often each occurs: weights summing to 1."""
    x = (np.arange(n) + 0.5) / n * 2 - 1
    often = 1 - np.abs(x)
    often /= often.sum()
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    return points, np.einsum("i,j,k->ijk", often, often, often).ravel()


def _self_kernel(linear: Floats, radial: Radial) -> float:
    """The mean of the kernel between two points of one voxel, in polar coordinates, where its pole at 0 is none."""
    z = 1 - (2 * np.arange(_DIRECTIONS) + 1) / _DIRECTIONS
    turn = math.pi * (1 + math.sqrt(5)) * np.arange(_DIRECTIONS)
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)  # in voxels
    farthest = 1 / np.abs(directions).max(axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)  # type: ignore[no-untyped-call]
    s = farthest[:, None] * (nodes + 1) / 2
    often = np.prod(1 - np.abs(s[..., None] * directions[:, None]), axis=-1)
    stretch = np.linalg.norm(directions @ linear.T, axis=1)[:, None]  # mm of one voxel in each direction
    along = (often * radial(s * stretch) / stretch**2) @ weights * farthest / 2
    return float(along.mean())


def convolved(values: Floats, kernel: Floats) -> Floats:
    """`values` with a wrapped kernel twice as long along each axis."""
    axes, sizes = (0, 1, 2), kernel.shape
    product = np.fft.rfftn(values, sizes, axes) * np.fft.rfftn(kernel, sizes, axes)
    return np.fft.irfftn(product, sizes, axes)[tuple(slice(n) for n in values.shape)]


def _densities(density: ArrayLike | None, grid: Grid) -> Floats:
    values = all_above_0(1.0 if density is None else density, "density", unit="g/cm^3")
    if values.shape not in ((), grid.shape):
        raise InputError(f"density: expected one number or an array of {grid.shape}, got {values.shape}")
    return freeze(np.broadcast_to(values, grid.shape).copy())
