"""Isotopes of nuclear medicine, their half-lives and photons.

Half-lives and gamma rays: ENSDF, the Evaluated Nuclear Structure Data File of the National Nuclear Data Center,
Brookhaven (nndc.bnl.gov/ensdf), as distributed with paceENSDF 0.6.3. The x rays of Tl-201 and Xe-133 and Tc-99m's gamma
ray: the decay library UKDD-12, as distributed with actigamma 0.1.5. F-18's photons: European Pharmacopoeia, chapter
5.7.

Lines are the gamma rays of more than 1 % of decays and the K x rays of Tl-201 and Xe-133. X rays that are not imaged
are left out: the other isotopes' below 35 keV, and Lu-177's (54 to 63 keV, 6 % of decays).
Evaluations differ by as much as 3 % (Tc-99m: 0.885 to 0.891; Xe-133's 81 keV: 0.369 to 0.380).
"""

import math
from dataclasses import dataclass

from ..errors import InputError
from ..validation import one_of, positive

_HOUR = 3600.0
_DAY = 24 * _HOUR


@dataclass(frozen=True)
class Isotope:
    """An isotope and the photons that it is imaged with."""

    name: str  # such as "Tc-99m"
    half_life: float  # s
    lines: tuple[tuple[float, float], ...]  # energy, keV, and photons per decay, by energy

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
        """``(1 - exp(-lambda t)) / lambda``, s: in this time the initial activity decays as often as within `duration`."""
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
        # The x rays of caesium after xenon's decay are seldom imaged, those of mercury after thallium's always.
        Isotope("Xe-133", 5.2475 * _DAY, ((30.6, 0.133), (31.0, 0.245), (35.0, 0.088), (81.0, 0.369))),
        Isotope("Lu-177", 6.6443 * _DAY, ((112.9, 0.062), (208.4, 0.104))),
        Isotope("Tl-201", 3.042 * _DAY, ((68.9, 0.277), (70.8, 0.471), (80.3, 0.207), (135.3, 0.026), (167.4, 0.100))),
    )
}
"""The isotopes by name."""


def isotope(name: str) -> Isotope:
    """The isotope of a name such as "Tc-99m"; `InputError` lists the names."""
    one_of(name, ISOTOPES, "isotope")
    return ISOTOPES[name]


def photon_energy(value: float | str) -> float:
    """A photon energy, keV, from a number or its text, or from the name of an isotope: that of its strongest line."""
    if value in ISOTOPES:
        return max(ISOTOPES[str(value)].lines, key=lambda line: line[1])[0]
    try:
        return float(value)
    except ValueError:
        raise InputError(f"energy {value!r}: expected keV, or one of {', '.join(ISOTOPES)}") from None
