"""Materials of apertures, crystals, bodies and phantoms (materials.txt), and their attenuation coefficients.

A material's coefficient at any energy is the sum of its elements' `mass_attenuation` coefficients, weighted by mass.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from ..arrays import Floats, is_tensor
from ..errors import InputError, naming, warn
from ..geometry.collimator import edge_slope
from ..geometry.system import PinholeSystem
from ..validation import positive
from .mass_attenuation import HIGHEST_ENERGY, LOWEST_ENERGY, mass_attenuation, table_lines


@dataclass(frozen=True)
class Material:
    """Density, g/cm^3, and composition of a material: the fraction of its mass that each element (by symbol) has."""

    density: float
    composition: dict[str, float]


def _read(line: str) -> tuple[str, Material]:
    """A line of the table: "name: density symbol share symbol share …"."""
    name, _, numbers = line.partition(":")
    density, *composition = numbers.split()
    return name, Material(float(density), dict(zip(composition[::2], map(float, composition[1::2]), strict=True)))


MATERIALS = dict(map(_read, table_lines("materials.txt")))
"""The materials by name."""

# Linear attenuation coefficients at Tc-99m's 140.5 keV and no other energy, 1/mm, rounded: density times the total mass
# attenuation coefficient of W. T. Elam et al., Radiation Physics and Chemistry 63 (2002) 121-128 (as in XrayDB 4).
TUNGSTEN_MU, LEAD_MU, NAI_MU, CZT_MU, WATER_MU = 3.60, 2.69, 0.262, 0.404, 0.0154

APERTURES = ("tungsten", "lead", "gold", "uranium")
CRYSTALS = ("NaI", "CsI", "CZT", "CdTe", "BGO", "LYSO", "GAGG")

_NAMES = {name.lower(): name for name in MATERIALS}


def attenuation(material: str, energy: float) -> float:
    """Linear attenuation coefficient, 1/mm, of a material at a photon energy.

    The material is one of `MATERIALS`, in upper or lower case (at another density, the coefficient is in proportion), the
    energy from 10 to 1000 keV. It agrees with Elam et al. (2002) within 0.3 % from 30 keV on and within 0.5 % below.
    """
    made = _known(material)
    energy = positive(energy, "energy", "keV")
    if not LOWEST_ENERGY <= energy <= HIGHEST_ENERGY:
        raise InputError(f"energy {energy:g} keV: expected {LOWEST_ENERGY:g} to {HIGHEST_ENERGY:g} keV")
    shares = made.composition.items()
    return made.density / 10 * sum(share * mass_attenuation(symbol, energy) for symbol, share in shares)


def module_coefficients(
    aperture: str | float | None,
    crystal: str | float | Floats | None,
    lines: Sequence[tuple[float, float]],
    system: PinholeSystem,
    opening_angle: float,
) -> tuple[float | None, float | Floats | None]:
    """Attenuation coefficients, 1/mm, of the apertures and of the crystals, effective over all photon energies.

    With these coefficients as many photons along the axis pass the mean hole, by Paix's
    ``d_e^2 = d (d + 2 / mu tan(alpha / 2))``, and are stopped by the mean crystal behind it, as of all lines together.

    Materials are as in `attenuation`; numbers and None are returned unchanged. Lines are energies, keV, and numbers of
    photons, as in `Isotope.lines`, and the opening angle is alpha, rad. A module with a `crystal_material` has the
    coefficient (M,) of that, for its own thickness, unless `crystal` has a number for each module.
    """
    photons = np.array([photons for _, photons in lines])
    if isinstance(aperture, str):
        mu = _at_lines(aperture, lines, "aperture_mu")
        depth = 2 / mu * edge_slope(opening_angle)
        aperture = float(mu.min() / np.average(mu.min() / mu, weights=photons))  # d_e^2 is linear in 1/mu
        photons = photons * (system.pinhole_diameter.mean() + depth)

    def stopping(material: str, thickness: float, name: str) -> float:
        mu = _at_lines(material, lines, name)
        passed = np.average(np.exp((mu.min() - mu) * thickness), weights=photons)
        return float(mu.min() - np.log(passed) / thickness)

    if isinstance(crystal, str):
        crystal = stopping(crystal, system.detector_thickness.mean(), "crystal_mu")
    own = system.crystal_material
    named = own != ""
    if not named.any() or is_tensor(crystal) or isinstance(crystal, np.ndarray):
        return aperture, crystal
    if not lines:
        warn("the modules' crystal materials are not used: without an isotope their photons have no energy")
        return aperture, crystal
    if crystal is None and not named.all():
        without = f"module {system.numbers[np.argmin(named)]} has no crystal material, others have"
        raise InputError(f"{without}: expected one for each, or crystal_mu for the rest")
    stopping_own = lru_cache(maxsize=None)(partial(stopping, name="crystal_material"))
    each = zip(own.tolist(), system.detector_thickness.tolist(), strict=True)
    return aperture, np.array([stopping_own(*one) if one[0] else crystal for one in each], np.float64)


def _known(material: str) -> Material:
    name = _NAMES.get(material.lower().replace("_", " ").replace("-", " ")) if isinstance(material, str) else None
    if name is None:
        raise InputError(f"material {material!r}: expected one of {', '.join(MATERIALS)}")
    return MATERIALS[name]


def _at_lines(material: str, lines: Sequence[tuple[float, float]], name: str) -> Floats:
    with naming(name):
        _known(material)  # refuses an unknown material even without lines
        coefficients = [attenuation(material, energy) for energy, _ in lines]
    if not lines:
        expected = "an isotope with photons in its window, or a number, 1/mm"
        raise InputError(f"{name} {material!r}: at which energy? expected {expected}")
    return np.array(coefficients)
