"""Scattering of photons by materials: differential cross sections, and how much of the attenuation is scattering.

Photons scatter on single atoms: by Klein and Nishina's law times the incoherent scattering function S(x), and by Thomson's
law times the squared form factor F(x). The functions are in photon_scattering.txt; the total attenuation is `attenuation`'s.

References
----------
J. H. Hubbell et al., "Atomic form factors, incoherent scattering functions, and photon scattering cross sections", J. Phys.
Chem. Ref. Data 4 (1975) 471-538.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from .mass_attenuation import table_lines
from .materials import MATERIALS, attenuation

ELECTRON_ENERGY = 510.99895
"""Energy of an electron at rest, keV."""
WAVELENGTH_ENERGY = 12.398420
"""Photon energy, keV, times its wavelength, angstrom."""
_RADIUS_SQUARED = 7.9407877e-26  # of the classical electron, cm^2
_AVOGADRO = 6.02214076e23
_ANGLES = 4096  # of which totals are sums


@dataclass(frozen=True)
class Scatterer:
    """Scattering of photons by a material of its own density."""

    material: str

    def incoherent_function(self, x: ArrayLike) -> Floats:
        """Return S at momentum transfers x, 1/angstrom, summed over the atoms of a mm^3, times r_e^2 / 2: in 1/mm."""
        return self._summed("S", x)

    def coherent_function(self, x: ArrayLike) -> Floats:
        """Return F^2 at momentum transfers x, 1/angstrom, summed over the atoms of a mm^3, times r_e^2 / 2: in 1/mm."""
        return self._summed("F", x)

    def incoherent(self, energy: float, cosine: ArrayLike) -> Floats:
        """Return the attenuation by Compton scattering at an energy, keV, towards angles of these cosines, 1/mm per sr."""
        ratio = compton_ratio(energy, cosine)
        law = ratio**2 * (ratio + 1 / ratio - 1 + np.square(cosine))
        return self.incoherent_function(momentum_transfer(energy, cosine)) * law

    def coherent(self, energy: float, cosine: ArrayLike) -> Floats:
        """Return the attenuation by Rayleigh scattering at an energy, keV, towards angles of these cosines, 1/mm per sr."""
        return self.coherent_function(momentum_transfer(energy, cosine)) * (1 + np.square(cosine))

    def coefficients(self, energy: float) -> tuple[float, float, float]:
        """Return the total, the incoherent and the coherent attenuation coefficient at an energy, keV, 1/mm."""
        # Even steps of the angle's third root resolve the forward peak of Rayleigh scattering.
        angles = np.pi * ((np.arange(_ANGLES) + 0.5) / _ANGLES) ** 3
        widths = 3 * np.pi * ((np.arange(_ANGLES) + 0.5) / _ANGLES) ** 2 / _ANGLES * 2 * np.pi * np.sin(angles)
        incoherent, coherent = (float(law(energy, np.cos(angles)) @ widths) for law in (self.incoherent, self.coherent))
        return max(attenuation(self.material, energy), incoherent + coherent), incoherent, coherent

    def _summed(self, letter: str, x: ArrayLike) -> Floats:
        """Return r_e^2 / 2 times the sum over the atoms of a mm^3 of S or F^2 at x."""
        momenta, elements = _table()
        logs = np.log(np.maximum(x, momenta[0]))
        beyond = np.minimum(np.asarray(x, np.float64) / momenta[0], 1.0)  # below the table S goes to 0 as x^2
        total = np.zeros(np.shape(x))
        for symbol, share in self._elements:
            weight, functions = elements[symbol]
            values = np.exp(np.interp(logs, np.log(momenta), np.log(functions[letter])))
            atoms = share / weight
            total += atoms * (values**2 if letter == "F" else values * beyond**2)
        return total * (_AVOGADRO * MATERIALS[self.material].density * _RADIUS_SQUARED / 2 / 10)

    @cached_property
    def _elements(self) -> tuple[tuple[str, float], ...]:
        """Elements with their shares of the mass."""
        elements = tuple(MATERIALS[self.material].composition.items())
        if unknown := [symbol for symbol, _ in elements if symbol not in _table()[1]]:
            raise InputError(f"scattering: no table for {', '.join(unknown)}, of {self.material}")
        return elements


def compton_ratio(energy: float, cosine: ArrayLike) -> Floats:
    """Return the energy after Compton scattering by angles of these cosines, as a share of the `energy` before, keV."""
    return 1 / (1 + energy / ELECTRON_ENERGY * (1 - np.asarray(cosine, np.float64)))


def momentum_transfer(energy: float, cosine: ArrayLike) -> Floats:
    """Return x = sin(theta / 2) / wavelength, 1/angstrom, of an energy, keV, and angles theta of these cosines."""
    return energy / WAVELENGTH_ENERGY * np.sqrt(np.maximum(1 - np.asarray(cosine, np.float64), 0) / 2)


@cache
def _table() -> tuple[Floats, dict[str, tuple[float, dict[str, Floats]]]]:
    """Read the table: the momentum transfers, and by element its atomic weight and the functions "F" and "S"."""
    first, *rows = map(str.split, table_lines("photon_scattering.txt"))
    elements: dict[str, tuple[float, dict[str, Floats]]] = {}
    for symbol, letter, *numbers in rows:
        if letter == "A":
            elements[symbol] = (float(numbers[0]), {})
        else:
            elements[symbol][1][letter] = np.array(numbers, float)
    return np.array(first[1:], float), elements
