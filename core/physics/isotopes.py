"""Isotopes of nuclear medicine, and what stops their photons.

Half-lives and gamma rays: ENSDF, the Evaluated Nuclear Structure Data File of the National Nuclear Data Center,
Brookhaven (nndc.bnl.gov/ensdf), as distributed with paceENSDF 0.6.3. The x rays of Tl-201 and Xe-133 and Tc-99m's gamma
ray: the decay library UKDD-12, as distributed with actigamma 0.1.5. F-18's photons: European Pharmacopoeia, chapter 5.7.

Lines: the gamma rays of more than 1 % of decays, to the digits given, and the K x rays of Tl-201 and Xe-133. Left out
are the x rays that are not imaged: the other isotopes' below 35 keV, and Lu-177's (54 to 63 keV, 6 % of decays).
Evaluations differ by as much as 3 % (Tc-99m: 0.885 to 0.891; Xe-133's 81 keV: 0.369 to 0.380).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import InputError
from ..validation import positive

# Linear attenuation coefficients at Tc-99m's 140.5 keV and at no other energy (`materials.attenuation` is for all), 1/mm:
# density times the total mass attenuation coefficient from W. T. Elam et al., Radiation Physics and Chemistry 63 (2002)
# 121-128 (as in XrayDB 4). At Tl-201's 71 keV tungsten's is 20.6, just above its K edge (69.5 keV), lead's 3.7, below its
# own (88.0 keV).
TUNGSTEN_MU = 3.60
"""Tungsten, 19.3 g/cm^3, at 140.5 keV."""
LEAD_MU = 2.69
"""Lead, 11.35 g/cm^3, at 140.5 keV."""
NAI_MU = 0.262
"""Sodium iodide, 3.67 g/cm^3, at 140.5 keV."""
CZT_MU = 0.404
"""Cadmium zinc telluride, Cd0.9 Zn0.1 Te, 5.78 g/cm^3, at 140.5 keV."""
WATER_MU = 0.0154
"""Water, 1 g/cm^3, at 140.5 keV."""

_HOUR = 3600.0
_DAY = 24 * _HOUR


@dataclass(frozen=True)
class Isotope:
    """An isotope and the photons it is imaged by.

    Attributes
    ----------
    name : str
        Such as ``"Tc-99m"``.
    half_life : float
        s.
    lines : tuple of (float, float)
        Energy in keV and photons per decay, by energy.
    """

    name: str
    half_life: float
    lines: tuple[tuple[float, float], ...]

    @property
    def window(self) -> tuple[float, float]:
        """The usual energy window, keV: 10 % to either side of the strongest line."""
        energy, _ = max(self.lines, key=lambda line: line[1])
        return 0.9 * energy, 1.1 * energy

    def photons_per_decay(self, low: float, high: float) -> float:
        """Photons per decay in the energy window from `low` to `high`, keV."""
        return sum(photons for _, photons in self.lines_within(low, high))

    def lines_within(self, low: float, high: float) -> tuple[tuple[float, float], ...]:
        """The `lines` in the energy window from `low` to `high`, keV."""
        return tuple((energy, photons) for energy, photons in self.lines if low <= energy <= high)

    def mean_decay_time(self, duration: float) -> float:
        """The time, s, in which the activity at the start would make all decays of `duration`, s: what is lost by decay.

        ``(1 - exp(-lambda t)) / lambda``.
        """
        rate = math.log(2) / self.half_life
        return -math.expm1(-rate * positive(duration, "duration", "s")) / rate


ISOTOPES = {
    isotope.name: isotope
    for isotope in (
        Isotope("F-18", 109.77 * 60, ((511.0, 1.935),)),
        Isotope(
            "Ga-67",
            3.2617 * _DAY,
            ((91.3, 0.031), (93.3, 0.388), (184.6, 0.214), (209.0, 0.025), (300.2, 0.166), (393.5, 0.046)),
        ),
        Isotope("Tc-99m", 6.007 * _HOUR, ((140.5, 0.891),)),
        Isotope("In-111", 2.8047 * _DAY, ((171.3, 0.907), (245.4, 0.941))),
        Isotope("I-123", 13.223 * _HOUR, ((159.0, 0.836), (529.0, 0.013))),
        Isotope(
            "I-131", 8.0252 * _DAY, ((80.2, 0.026), (284.3, 0.061), (364.5, 0.815), (637.0, 0.072), (722.9, 0.018))
        ),
        # The x rays of xenon's daughter, caesium, are imaged seldom, those of thallium's, mercury, always.
        Isotope("Xe-133", 5.2475 * _DAY, ((30.6, 0.133), (31.0, 0.245), (35.0, 0.088), (81.0, 0.369))),
        Isotope("Lu-177", 6.6443 * _DAY, ((112.9, 0.062), (208.4, 0.104))),
        Isotope("Tl-201", 3.042 * _DAY, ((68.9, 0.277), (70.8, 0.471), (80.3, 0.207), (135.3, 0.026), (167.4, 0.100))),
    )
}
"""The isotopes by name."""


def isotope(name: str) -> Isotope:
    """The isotope `name` ("Tc-99m"), or `InputError` with the names there are."""
    try:
        return ISOTOPES[name]
    except KeyError:
        raise InputError(f"isotope {name!r}: expected one of {', '.join(ISOTOPES)}") from None


def photon_energy(value: float | str) -> float:
    """A photon energy, keV, from a number or its text, or from the name of an isotope: that of its strongest line.

    Raises
    ------
    InputError
        Neither a number nor an isotope.
    """
    if value in ISOTOPES:
        energy, _ = max(ISOTOPES[str(value)].lines, key=lambda line: line[1])
        return energy
    try:
        return float(value)
    except ValueError:
        raise InputError(f"energy {value!r}: expected keV, or one of {', '.join(ISOTOPES)}") from None
