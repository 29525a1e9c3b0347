"""Isotopes of nuclear medicine, their half-lives and photons: the table in isotopes.txt."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import expecting
from ..validation import all_above_0, one_of, positive, real_array
from .mass_attenuation import table_lines

_SECONDS = {"min": 60.0, "h": 3600.0, "d": 24 * 3600.0}

Line = tuple[float, float]
"""Energy, keV, and photons per decay."""
Window = tuple[float, float]
"""Energies, keV, between which photons are counted."""


@dataclass(frozen=True)
class Isotope:
    """An isotope and the photons that it is imaged with."""

    name: str  # such as "Tc-99m"
    half_life: float  # s
    lines: tuple[Line, ...]  # by energy

    @property
    def window(self) -> Window:
        """The usual energy window, keV: 10 % to either side of the strongest line."""
        energy, _ = max(self.lines, key=lambda line: line[1])
        return 0.9 * energy, 1.1 * energy

    def photons_per_decay(self, low: float, high: float) -> float:
        """Photons per decay in the energy window from `low` to `high`, keV."""
        return sum(photons for _, photons in self.lines_within(low, high))

    def lines_within(self, low: float, high: float) -> tuple[Line, ...]:
        """The `lines` in the energy window from `low` to `high`, keV."""
        return tuple((energy, photons) for energy, photons in self.lines if low <= energy <= high)

    def mean_decay_time(self, duration: ArrayLike, start: ArrayLike = 0.0) -> float | Floats:
        """``exp(-lambda start) (1 - exp(-lambda t)) / lambda``, s: in this time the activity at 0 decays as often as from
        `start` on within the `duration` t, both s, numbers or arrays.
        """
        rate, times = math.log(2) / self.half_life, all_above_0(duration, "duration", unit="s")
        found = np.exp(-rate * real_array(start, "start", None)) * -np.expm1(-rate * times) / rate
        return found if found.ndim else float(found)

    def duration(self, share: float, whole: float) -> float:
        """The time, s, from the start, in which a `share` of the decays of a `whole` duration, s, happens."""
        rate = math.log(2) / self.half_life
        return -math.log1p(share * math.expm1(-rate * positive(whole, "duration", "s"))) / rate


def _read(line: str) -> Isotope:
    """A line of the table: name, half-life and its unit, then energy and photons per decay of each line."""
    name, half_life, unit, *numbers = line.split()
    energies, photons = map(float, numbers[::2]), map(float, numbers[1::2])
    return Isotope(name, float(half_life) * _SECONDS[unit], tuple(zip(energies, photons, strict=True)))


ISOTOPES = {isotope.name: isotope for isotope in map(_read, table_lines("isotopes.txt"))}
"""The isotopes by name."""


def isotope(name: str) -> Isotope:
    """The isotope of a name such as "Tc-99m"; `InputError` lists the names."""
    one_of(name, ISOTOPES, "isotope")
    return ISOTOPES[name]


def photon_energy(value: float | str) -> float:
    """A photon energy, keV, from a number or its text, or from the name of an isotope: that of its strongest line."""
    if value in ISOTOPES:
        return max(ISOTOPES[str(value)].lines, key=lambda line: line[1])[0]
    with expecting(f"energy {value!r}: expected keV, or one of {', '.join(ISOTOPES)}"):
        return float(value)
