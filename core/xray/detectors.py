"""Response of X-ray detectors to photons: counts in energy bins, or absorbed energy."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError, naming
from ..validation import at_least_0, freeze, none_below_0, positive, real_array
from .coefficients import attenuations

Bins = Sequence[tuple[float, float]]
"""Lower and upper energies, keV: ascending, not overlapping. A photon on a bin's lower edge is in it."""

_SIGMA = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian of full width at half maximum 1."""


class PanelDetector(Protocol):
    """Response of a panel's pixels to photons."""

    def response(self, energies: Floats, bins: Bins | None) -> Floats:
        """Return the contribution to each bin of one photon of each energy (n,), keV, that hits the pixel: (bins, n)."""


@dataclass(frozen=True, eq=False)
class PhotonCounter:
    """A detector that counts photons in energy bins; by default every photon, in the bin of its energy.

    Photons cross the sensor at a right angle. Each absorbed photon is counted once, at its energy; escaping fluorescence and
    charge shared by neighbouring pixels are described by `sharing`.

    Attributes
    ----------
    material : str or None
        Material of the sensor, such as "CdTe" or "silicon"; None stops every photon.
    thickness : float
        Thickness of the sensor, mm.
    energy_fwhm : float
        Full width at half maximum, keV, of the Gaussian that blurs energies; 0 for none.
    sharing : array (bins, bins) or None
        Counts in bin i (row) for each photon that would be counted in bin j (column).
    """

    material: str | None = None
    thickness: float = 2.0
    energy_fwhm: float = 0.0
    sharing: ArrayLike | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "thickness", positive(self.thickness, "detector: thickness", "mm"))
        object.__setattr__(self, "energy_fwhm", at_least_0(self.energy_fwhm, "detector: energy_fwhm", "keV"))
        if self.sharing is not None:
            sharing = none_below_0(self.sharing, "detector: sharing", (None, None))
            object.__setattr__(self, "sharing", freeze(sharing))

    def response(self, energies: Floats, bins: Bins | None) -> Floats:
        """Return the expected counts (bins, n) of one photon of each energy (n,), keV."""
        if bins is None:
            raise InputError("bins: a detector that counts photons needs them, such as ((20, 60), (60, 120))")
        edges = checked_bins(bins)
        if self.energy_fwhm:
            deviations = (edges[:, :, None] - energies) / (self.energy_fwhm * _SIGMA * math.sqrt(2))
            fraction_below = np.array([math.erf(x) for x in deviations.flat]).reshape(deviations.shape) / 2
            counts = fraction_below[:, 1] - fraction_below[:, 0]
        else:
            counts = ((edges[:, :1] <= energies) & (energies < edges[:, 1:])).astype(float)
        if self.sharing is not None:
            counts = real_array(self.sharing, "detector: sharing", (len(edges), len(edges))) @ counts
        return counts * absorbed_fraction(self.material, self.thickness, energies)


@dataclass(frozen=True)
class EnergyIntegrator:
    """A panel without bins: its signal is the energy, keV, of the photons that its scintillator absorbs.

    Attributes
    ----------
    material : str or None
        Material of the scintillator, such as "CsI"; None stops every photon.
    thickness : float
        Thickness of the scintillator, mm.
    """

    material: str | None = "CsI"
    thickness: float = 0.6

    def __post_init__(self) -> None:
        object.__setattr__(self, "thickness", positive(self.thickness, "detector: thickness", "mm"))

    def response(self, energies: Floats, bins: Bins | None) -> Floats:
        """Return the absorbed energy (1, n), keV, of one photon of each energy (n,), keV."""
        if bins is not None:
            raise InputError("bins: a detector that integrates the energy has none: expected None")
        return (energies * absorbed_fraction(self.material, self.thickness, energies))[None]


def absorbed_fraction(material: str | None, thickness: float, energies: Floats) -> Floats:
    """Return the fraction (n,) of photons of each energy that `thickness`, mm, of a material stops; 1 for None."""
    if material is None:
        return np.ones(len(energies))
    with naming("detector"):
        return -np.expm1(-thickness * attenuations(material, energies))


def checked_bins(bins: Bins) -> Floats:
    """Return bins as an array (bins, 2); raise `InputError` if one is empty, out of order, or overlaps the next."""
    edges = real_array(bins, "bins", (None, 2))
    if not len(edges):
        raise InputError("bins: expected one or more, got none")
    for i, (low, high) in enumerate(edges):
        if not 0 <= low < high:
            raise InputError(f"bins: bin {i}: expected a lower and a higher energy, keV, got {low:g} and {high:g}")
        if i and low < edges[i - 1, 1]:
            upper = edges[i - 1, 1]
            raise InputError(f"bins: bins {i - 1} and {i} overlap or are out of order: {low:g} < {upper:g} keV")
    return edges
