"""Materials of apertures, crystals, bodies and phantoms, and their attenuation coefficients.

A material's coefficient at any energy is the sum of its elements' `mass_attenuation` coefficients, weighted by mass.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from ..arrays import is_tensor
from ..errors import InputError, naming, warn
from ..geometry.collimator import edge_slope
from ..geometry.system import PinholeSystem
from ..validation import positive
from .mass_attenuation import HIGHEST_ENERGY, LOWEST_ENERGY, mass_attenuation


@dataclass(frozen=True)
class Material:
    """Density, g/cm^3, and composition of a material: the fraction of its mass that each element (by symbol) has."""

    density: float
    composition: dict[str, float]


# ICRU Report 46 (1992): vertebral column with its cartilage (D6, L3).
_VERTEBRA = {
    "H": 0.07, "C": 0.287, "N": 0.038, "O": 0.437, "Mg": 0.001, "P": 0.051, "S": 0.002, "Cl": 0.001, "K": 0.001, "Ca": 0.111,
    "Fe": 0.001,
}  # fmt: skip

MATERIALS = {
    # Elements and their densities: NIST Standard Reference Database 126, table 1.
    "tungsten": Material(19.3, {"W": 1.0}),
    "lead": Material(11.35, {"Pb": 1.0}),
    "gold": Material(19.32, {"Au": 1.0}),
    "uranium": Material(18.95, {"U": 1.0}),  # depleted or not
    # Crystals: formulas, and densities given by the makers; without dopants.
    "NaI": Material(3.67, {"Na": 0.15338, "I": 0.84662}),
    "CsI": Material(4.51, {"Cs": 0.51157, "I": 0.48843}),
    "CZT": Material(5.78, {"Cd": 0.42994, "Zn": 0.02778, "Te": 0.54227}),  # Cd0.9 Zn0.1 Te
    "CdTe": Material(5.85, {"Cd": 0.46836, "Te": 0.53164}),
    "BGO": Material(7.13, {"Bi": 0.67099, "Ge": 0.1749, "O": 0.15411}),  # Bi4 Ge3 O12
    "LYSO": Material(7.1, {"Lu": 0.71448, "Y": 0.04034, "Si": 0.06371, "O": 0.18147}),  # Lu1.8 Y0.2 Si O5
    "GAGG": Material(6.63, {"Gd": 0.50897, "Al": 0.05822, "Ga": 0.22567, "O": 0.20714}),  # Gd3 Al2 Ga3 O12
    # NIST's table 2: tissues of ICRU Report 44 (1989); bone is cortical, lung inflated.
    "water": Material(1.0, {"H": 0.111898, "O": 0.888102}),
    "air": Material(1.20479e-3, {"C": 0.000124, "N": 0.755268, "O": 0.231781, "Ar": 0.012827}),
    "PMMA": Material(1.19, {"H": 0.080541, "C": 0.599846, "O": 0.319613}),
    "soft tissue": Material(
        1.06,
        {"H": 0.102, "C": 0.143, "N": 0.034, "O": 0.708, "Na": 0.002, "P": 0.003, "S": 0.003, "Cl": 0.002, "K": 0.003},
    ),
    "muscle": Material(
        1.05,
        {"H": 0.102, "C": 0.143, "N": 0.034, "O": 0.71, "Na": 0.001, "P": 0.002, "S": 0.003, "Cl": 0.001, "K": 0.004},
    ),
    "adipose tissue": Material(
        0.95, {"H": 0.114, "C": 0.598, "N": 0.007, "O": 0.278, "Na": 0.001, "S": 0.001, "Cl": 0.001}
    ),
    "lung": Material(
        0.26,
        {"H": 0.103, "C": 0.105, "N": 0.031, "O": 0.749, "Na": 0.002, "P": 0.002, "S": 0.003, "Cl": 0.003, "K": 0.002},
    ),
    "vertebra": Material(1.33, _VERTEBRA),
    "bone": Material(
        1.92,
        {"H": 0.034, "C": 0.155, "N": 0.042, "O": 0.435, "Na": 0.001, "Mg": 0.002, "P": 0.103, "S": 0.003, "Ca": 0.225},
    ),
}
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
    return (
        made.density / 10 * sum(share * mass_attenuation(symbol, energy) for symbol, share in made.composition.items())
    )


def module_coefficients(
    aperture: str | float | None,
    crystal: str | float | NDArray[np.float64] | None,
    lines: Sequence[tuple[float, float]],
    system: PinholeSystem,
    opening_angle: float,
) -> tuple[float | None, float | NDArray[np.float64] | None]:
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
        number = system.numbers[np.argmin(named)]
        raise InputError(
            f"module {number} has no crystal material, others have: expected one for each, or crystal_mu for the rest"
        )
    stopping_own = lru_cache(maxsize=None)(partial(stopping, name="crystal_material"))
    each = zip(own.tolist(), system.detector_thickness.tolist(), strict=True)
    return aperture, np.array([stopping_own(*one) if one[0] else crystal for one in each], np.float64)


def _known(material: str) -> Material:
    name = _NAMES.get(material.lower().replace("_", " ").replace("-", " ")) if isinstance(material, str) else None
    if name is None:
        raise InputError(f"material {material!r}: expected one of {', '.join(MATERIALS)}")
    return MATERIALS[name]


def _at_lines(material: str, lines: Sequence[tuple[float, float]], name: str) -> NDArray[np.float64]:
    with naming(name):
        _known(material)  # refuses an unknown material even without lines
        coefficients = [attenuation(material, energy) for energy, _ in lines]
    if not lines:
        raise InputError(
            f"{name} {material!r}: at which energy? expected an isotope with photons in its window, or a number, 1/mm"
        )
    return np.array(coefficients)
