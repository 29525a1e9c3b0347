"""Materials of apertures, crystals, bodies and phantoms (materials.txt), and their attenuation coefficients.

The coefficient of a material is its density times the sum of its elements' `mass_attenuation`, weighted by mass.
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
    """Material of a mixture of elements."""

    density: float  # g/cm^3
    composition: dict[str, float]  # fraction of the mass by the element's symbol


def _read(line: str) -> tuple[str, Material]:
    """Read a line of the table, "name: density symbol share symbol share …", as name and material."""
    name, _, numbers = line.partition(":")
    density, *composition = numbers.split()
    return name, Material(float(density), dict(zip(composition[::2], map(float, composition[1::2]), strict=True)))


MATERIALS = dict(map(_read, table_lines("materials.txt")))
"""Materials by name."""

# Linear attenuation coefficients, 1/mm, at Tc-99m's 140.5 keV alone, rounded: density times the total mass attenuation
# coefficient of W. T. Elam et al., Radiation Physics and Chemistry 63 (2002) 121-128 (as in XrayDB 4).
TUNGSTEN_MU, LEAD_MU, NAI_MU, CZT_MU, WATER_MU = 3.60, 2.69, 0.262, 0.404, 0.0154

APERTURES = ("tungsten", "lead", "gold", "uranium")
CRYSTALS = ("NaI", "CsI", "CZT", "CdTe", "BGO", "LYSO", "GAGG")

_NAMES = {name.lower(): name for name in MATERIALS}


def attenuation(material: str, energy: float) -> float:
    """Return the linear attenuation coefficient, 1/mm, of a material at a photon energy.

    The material is one of `MATERIALS`, in upper or lower case; at another density, the coefficient is proportional to it.
    The energy is from 1 to 1000 keV. The result agrees with Elam et al. (2002) within 0.3 % from 30 keV on and within 0.5 %
    from 10 keV on.
    """
    mixture = _find_material(material)
    energy = positive(energy, "energy", "keV")
    if not LOWEST_ENERGY <= energy <= HIGHEST_ENERGY:
        raise InputError(f"energy {energy:g} keV: expected {LOWEST_ENERGY:g} to {HIGHEST_ENERGY:g} keV")
    shares = mixture.composition.items()
    return mixture.density / 10 * sum(share * mass_attenuation(symbol, energy) for symbol, share in shares)


def module_coefficients(
    aperture: str | float | None,
    crystal: str | float | Floats | None,
    lines: Sequence[tuple[float, float]],
    system: PinholeSystem,
    opening_angle: float,
) -> tuple[float | None, float | Floats | None]:
    """Return the attenuation coefficients, 1/mm, of apertures and crystals, effective over all photon energies.

    With these coefficients as many photons along the axis pass the mean hole, by Paix's
    ``d_e^2 = d (d + 2 / mu tan(alpha / 2))``, and are stopped by the mean crystal behind it, as of all lines together.

    `aperture` and `crystal` are names of materials (`attenuation`); numbers and None are returned unchanged. `lines` are
    energies, keV, and numbers of photons, as in `Isotope.lines`, and the opening angle is alpha, rad. If modules of the
    system have a `crystal_material`, the crystals' coefficients are (M,), each for its module's material and thickness,
    unless `crystal` already has a number for each module.
    """
    photons = np.array([photons for _, photons in lines])
    if isinstance(aperture, str):
        mu = _line_coefficients(aperture, lines, "aperture_mu")
        widening = 2 / mu * edge_slope(opening_angle)
        aperture = float(mu.min() / np.average(mu.min() / mu, weights=photons))  # d_e^2 is linear in 1/mu
        photons = photons * (system.pinhole_diameter.mean() + widening)

    def stopping_mu(material: str, thickness: float, name: str) -> float:
        """Return the coefficient, 1/mm, with which one energy is stopped as the lines are over `thickness`, mm."""
        mu = _line_coefficients(material, lines, name)
        passed = np.average(np.exp((mu.min() - mu) * thickness), weights=photons)
        return float(mu.min() - np.log(passed) / thickness)

    if isinstance(crystal, str):
        crystal = stopping_mu(crystal, system.detector_thickness.mean(), "crystal_mu")
    materials = system.crystal_material
    has_material = materials != ""
    if not has_material.any() or is_tensor(crystal) or isinstance(crystal, np.ndarray):
        return aperture, crystal
    if not lines:
        warn("the modules' crystal materials are not used: without an isotope their photons have no energy")
        return aperture, crystal
    if crystal is None and not has_material.all():
        problem = f"module {system.numbers[np.argmin(has_material)]} has no crystal material, others have"
        raise InputError(f"{problem}: expected one for each, or crystal_mu for the rest")
    module_mu = lru_cache(maxsize=None)(partial(stopping_mu, name="crystal_material"))
    crystals = zip(materials.tolist(), system.detector_thickness.tolist(), strict=True)
    return aperture, np.array([module_mu(name, t) if name else crystal for name, t in crystals], np.float64)


def _find_material(material: str) -> Material:
    """Return the material of this name, whatever its case; raise `InputError`, which lists the names, if there is none."""
    name = _NAMES.get(material.lower().replace("_", " ").replace("-", " ")) if isinstance(material, str) else None
    if name is None:
        raise InputError(f"material {material!r}: expected one of {', '.join(MATERIALS)}")
    return MATERIALS[name]


def _line_coefficients(material: str, lines: Sequence[tuple[float, float]], name: str) -> Floats:
    """Return the attenuation coefficients of a material at the energies of `lines`, 1/mm; messages begin with `name`."""
    with naming(name):
        _find_material(material)  # refuses an unknown material even without lines
        coefficients = [attenuation(material, energy) for energy, _ in lines]
    if not lines:
        expected = "an isotope with photons in its window, or a number, 1/mm"
        raise InputError(f"{name} {material!r}: at which energy? expected {expected}")
    return np.array(coefficients)
