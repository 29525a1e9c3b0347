"""Spectra of X-ray tubes with tungsten anodes: filters, half-value layers, air kerma."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from ..arrays import Floats
from ..errors import InputError, naming, needing
from ..validation import at_least_0, freeze, positive, real_array
from .coefficients import attenuations, energy_absorption, table_numbers

_ANGLE, _LOWEST, _STEP = 12.0, 1.0, 0.5  # the table's anode angle, degrees; least energy and step, keV
_SOFT, _NEGLIGIBLE = 10.0, 1e-6  # energy, keV, below which photons of less than this fraction of the kerma are left out
_FILTERS: Mapping[str, float] = MappingProxyType({"Al": 2.5})

_MICROGRAY = 1.602176634e-5
"""Air kerma, µGy, of 1 keV per mm^2 where the mass energy-absorption coefficient is 1 cm^2/g."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Number of photons by energy: of a tube, or any other, such as a single energy ``Spectrum([60], [1e5])``.

    Attributes
    ----------
    energies : array (n,)
        keV, ascending, from 1 to 1000.
    photons : array (n,)
        Photons of each energy, per mm^2 and mAs at 1 m from the source, without air between.
    """

    energies: Floats
    photons: Floats

    def __post_init__(self) -> None:
        energies = real_array(self.energies, "spectrum: energies", (None,))
        photons = real_array(self.photons, "spectrum: photons", (len(energies),))
        if not len(energies) or (np.diff(energies) <= 0).any() or energies[0] < _LOWEST or energies[-1] > 1000:
            raise InputError("spectrum: energies: expected one or more, ascending, from 1 to 1000 keV")
        if photons.min() < 0 or not photons.any():
            raise InputError("spectrum: photons: expected none below 0, and some above")
        object.__setattr__(self, "energies", freeze(energies))
        object.__setattr__(self, "photons", freeze(photons))

    @property
    def mean_energy(self) -> float:
        """Mean energy of the photons, keV."""
        return float(np.average(self.energies, weights=self.photons))

    @property
    def kerma(self) -> float:
        """Air kerma at 1 m, µGy per mAs; it falls with the square of the distance."""
        return float(self._kerma_terms(self.photons).sum())

    def filtered(self, filters: Mapping[str, float]) -> "Spectrum":
        """Return the spectrum behind filters: thicknesses, mm, by element ("Al", "Cu", "W" …) or name of `MATERIALS`.

        The lowest energies below 10 keV are left out where all of them together are less than 1e-6 of the air kerma.
        """
        photons = self.photons
        for material, thickness in filters.items():
            with naming("filters"):
                depth = at_least_0(thickness, str(material), "mm") * attenuations(material, self.energies)
            photons = photons * np.exp(-depth)
        kerma = np.cumsum(self._kerma_terms(photons))
        is_kept = (self.energies >= _SOFT) | (kerma >= _NEGLIGIBLE * kerma[-1])
        return Spectrum(self.energies[is_kept], photons[is_kept])

    def coarser(self, step: float) -> "Spectrum":
        """Return the spectrum in steps of `step` keV from 0 on, each at its photons' mean energy, for faster computing."""
        step_index = np.floor(self.energies / positive(step, "step", "keV") + 1e-9).astype(int)
        step_index -= step_index[0]
        photons = np.bincount(step_index, self.photons).astype(np.float64)
        total_energy = np.bincount(step_index, self.photons * self.energies)
        is_filled = photons > 0
        return Spectrum(total_energy[is_filled] / photons[is_filled], photons[is_filled])

    def half_value_layer(self, material: str) -> float:
        """Return the thickness, mm, of a material, as in `filtered`, that halves the air kerma."""
        return self.value_layer(material, 0.5)

    def value_layer(self, material: str, share: float) -> float:
        """Return the thickness, mm, of a material that reduces the air kerma to a `share` between 0 and 1.

        The second half-value layer is ``value_layer(material, 0.25) - value_layer(material, 0.5)``.
        """
        if not 0 < positive(share, "share") < 1:
            raise InputError(f"share: expected between 0 and 1, got {share:g}")
        mu = attenuations(material, self.energies)
        low, high = 0.0, -np.log(share) / mu.min()
        kerma = self._kerma_terms(self.photons)
        for _ in range(60):
            trial = (low + high) / 2
            low, high = (trial, high) if kerma @ np.exp(-mu * trial) > share * kerma.sum() else (low, trial)
        return float(high)

    def _kerma_terms(self, photons: Floats) -> Floats:
        """Return the air kerma (n,), µGy per mAs, of these numbers of photons of each energy."""
        return _MICROGRAY * photons * self.energies * energy_absorption("air", self.energies)


def tube_spectrum(kvp: float, filters: Mapping[str, float] = _FILTERS, angle: float = _ANGLE) -> Spectrum:
    """Return the spectrum of a tungsten tube at 1 m behind its filters, by default 2.5 mm of aluminum.

    Parameters
    ----------
    kvp
        Tube voltage, kV, from 20 to 150.
    filters
        As for `Spectrum.filtered`: all materials between anode and patient, including the equivalent of the tube's window
        and oil. Air absorbs, too: ``{"Al": 2.5, "air": 1000}``.
        Without a filter photons from 1 keV on are there, which do not leave tubes: most of the air kerma is theirs.
    angle
        Anode angle, degrees. Other angles than 12 are calculated by SpekPy, if it is installed.

    Returns
    -------
    Spectrum
        In steps of 0.5 keV, from a table made with SpekPy 2.5 (G. Poludniowski et al., Medical Physics 48 (2021) 3630),
        interpolated linearly between the table's voltages, which are 2 kV apart, below 40 kV 1 kV.

    Raises
    ------
    InputError
        The voltage is outside the table, a filter's material is unknown, or the angle is another one and SpekPy is missing.
    """
    kvp, angle = positive(kvp, "kvp", "kV"), positive(angle, "angle", "degrees")
    voltages, photons = _table()
    if not voltages[0] <= kvp <= voltages[-1]:
        raise InputError(f"kvp: expected {voltages[0]:g} to {voltages[-1]:g} kV, got {kvp:g}")
    if angle >= 90:
        raise InputError(f"angle: expected less than 90 degrees, got {angle:g}")
    if angle == _ANGLE:
        energies = np.asarray(_LOWEST + _STEP * (np.arange(photons.shape[1]) + 0.5), np.float64)
        row = min(int(np.searchsorted(voltages, kvp, "right")), len(voltages) - 1) - 1
        fraction = (kvp - voltages[row]) / (voltages[row + 1] - voltages[row])
        is_present = energies < kvp
        interpolated: Floats = (1 - fraction) * photons[row] + fraction * photons[row + 1]
        unfiltered = Spectrum(energies[is_present], interpolated[is_present])
    else:
        unfiltered = _spekpy_spectrum(kvp, angle)
    return unfiltered.filtered(filters)


@cache
def _table() -> tuple[Floats, Floats]:
    """Return the voltages (n,), kV, and photons (n, energies) of tube_spectra.txt."""
    table = table_numbers("tube_spectra.txt")
    return table[:, 0], table[:, 1:]


def _spekpy_spectrum(kvp: float, angle: float) -> Spectrum:
    """Return SpekPy's unfiltered spectrum at 1 m; raise `InputError` if SpekPy is not installed or refuses."""
    with needing("mphdrr[spectra]", f"angle: expected {_ANGLE:g} degrees, or SpekPy for {angle:g}"):
        import spekpy
    try:
        tube = spekpy.Spek(kvp=kvp, th=angle, dk=_STEP, z=100, mas=1)
    except Exception as error:
        raise InputError(f"tube spectrum: SpekPy refuses {kvp:g} kV and {angle:g} degrees ({error})") from error
    energies, photons = tube.get_spectrum()
    is_kept = energies > _LOWEST
    return Spectrum(energies[is_kept], photons[is_kept] * _STEP / 100)
