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

_ANGLE, _LOWEST, _STEP = 12.0, 10.0, 0.5  # the table's anode angle, degrees; least energy and step, keV
_FILTERS: Mapping[str, float] = MappingProxyType({"Al": 2.5})

_MICROGRAY = 1.602176634e-5
"""Air kerma, µGy, of 1 keV per mm^2 where the mass energy-absorption coefficient is 1 cm^2/g."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Number of photons by energy: of a tube, or any other, such as a single energy ``Spectrum([60], [1e5])``.

    Attributes
    ----------
    energies : array (n,)
        keV, ascending, from 10 to 1000.
    photons : array (n,)
        Photons of each energy, per mm^2 and mAs at 1 m from the source, without air between.
    """

    energies: Floats
    photons: Floats

    def __post_init__(self) -> None:
        energies = real_array(self.energies, "spectrum: energies", (None,))
        photons = real_array(self.photons, "spectrum: photons", (len(energies),))
        if not len(energies) or (np.diff(energies) <= 0).any() or energies[0] < 10 or energies[-1] > 1000:
            raise InputError("spectrum: energies: expected one or more, ascending, from 10 to 1000 keV")
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
        return self._kerma(self.photons)

    def filtered(self, filters: Mapping[str, float]) -> "Spectrum":
        """Return the spectrum behind filters: thicknesses, mm, by element ("Al", "Cu", "W" …) or name of `MATERIALS`."""
        photons = self.photons
        for material, thickness in filters.items():
            with naming("filters"):
                depth = at_least_0(thickness, str(material), "mm") * attenuations(material, self.energies)
            photons = photons * np.exp(-depth)
        return Spectrum(self.energies, photons)

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
        target = share * self.kerma
        for _ in range(60):
            trial = (low + high) / 2
            low, high = (trial, high) if self._kerma(self.photons * np.exp(-mu * trial)) > target else (low, trial)
        return float(high)

    def _kerma(self, photons: Floats) -> float:
        """Return the air kerma, µGy per mAs, of these numbers of photons at the spectrum's energies."""
        return _MICROGRAY * float(photons @ (self.energies * energy_absorption("air", self.energies)))


def tube_spectrum(kvp: float, filters: Mapping[str, float] = _FILTERS, angle: float = _ANGLE) -> Spectrum:
    """Return the spectrum of a tungsten tube at 1 m behind its filters, by default 2.5 mm of aluminum.

    Parameters
    ----------
    kvp
        Tube voltage, kV, from 40 to 150.
    filters
        As for `Spectrum.filtered`: all materials between anode and patient, including the equivalent of the tube's window
        and oil. Air absorbs, too: ``{"Al": 2.5, "air": 1000}``. Photons below 10 keV, which do not leave tubes, are omitted.
    angle
        Anode angle, degrees. Other angles than 12 are calculated by SpekPy, if it is installed.

    Returns
    -------
    Spectrum
        In steps of 0.5 keV, from a table made with SpekPy 2.5 (G. Poludniowski et al., Medical Physics 48 (2021) 3630),
        interpolated linearly between the table's voltages, which are 2 kV apart.

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
        row = min(int((kvp - voltages[0]) / 2), len(voltages) - 2)
        fraction = (kvp - voltages[row]) / 2
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
