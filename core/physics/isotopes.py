"""Isotopes of nuclear medicine, their half-lives and radiations, from the table in isotopes.txt."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import expecting
from ..validation import all_above_0, one_of, positive, real_array
from .mass_attenuation import table_lines

_SECONDS = {"min": 60.0, "h": 3600.0, "d": 24 * 3600.0}

Line = tuple[float, float]
"""Energy, keV, of a photon line, and its photons per decay."""
Window = tuple[float, float]
"""Lower and upper energy, keV, between which photons are counted."""


@dataclass(frozen=True)
class Isotope:
    """Isotope with the photons that are used to image it, and the other energy that its decays set free."""

    name: str  # name such as "Tc-99m"
    half_life: float  # s
    lines: tuple[Line, ...]  # photon lines, in order of energy
    weak_lines: tuple[Line, ...] = ()  # photon lines that are not counted, in order of energy
    electrons: float = 0.0  # mean energy of electrons, keV per decay
    soft_photons: float = 0.0  # mean energy of photons below 10 keV, which end where they begin, keV per decay

    @property
    def window(self) -> Window:
        """Usual energy window, keV: 10 % to either side of the strongest line."""
        energy, _ = max(self.lines, key=lambda line: line[1])
        return 0.9 * energy, 1.1 * energy

    def photons_per_decay(self, low: float, high: float) -> float:
        """Return the number of photons per decay in the energy window from `low` to `high`, keV."""
        return sum(photons for _, photons in self.lines_within(low, high))

    def lines_within(self, low: float, high: float) -> tuple[Line, ...]:
        """Return the photon lines in the energy window from `low` to `high`, keV."""
        return tuple((energy, photons) for energy, photons in self.lines if low <= energy <= high)

    def mean_decay_time(self, duration: ArrayLike, start: ArrayLike = 0.0) -> float | Floats:
        """Return the time, s, in which the activity of time 0, if constant, would decay as often as in the `duration`.

        The duration t, s, begins at the time `start`, s; both are numbers or arrays. The result is
        ``exp(-lambda start) (1 - exp(-lambda t)) / lambda``.
        """
        rate, times = math.log(2) / self.half_life, all_above_0(duration, "duration", unit="s")
        decay_time = np.exp(-rate * real_array(start, "start", None)) * -np.expm1(-rate * times) / rate
        return decay_time if decay_time.ndim else float(decay_time)

    def duration(self, share: float, whole: float) -> float:
        """Return the time, s, from the start, in which a `share` of the decays of the `whole` duration, s, happens."""
        rate = math.log(2) / self.half_life
        return -math.log1p(share * math.expm1(-rate * positive(whole, "duration", "s"))) / rate


def _read(line: str) -> Isotope:
    """Read a line of the table: name, half-life and its unit, energies per decay, then photon lines, and weak ones."""
    strong, _, weak = line.partition("weak")
    name, half_life, unit, electrons, soft, *numbers = strong.split()
    return Isotope(
        name, float(half_life) * _SECONDS[unit], _lines(numbers), _lines(weak.split()), float(electrons), float(soft)
    )


def _lines(words: list[str]) -> tuple[Line, ...]:
    """Return photon lines from their energies and photons per decay in turn."""
    return tuple((float(energy), float(photons)) for energy, photons in zip(words[::2], words[1::2], strict=True))


ISOTOPES = {isotope.name: isotope for isotope in map(_read, table_lines("isotopes.txt"))}
"""Isotopes by name."""


def isotope(name: str) -> Isotope:
    """Return the isotope of a name such as "Tc-99m"; raise `InputError`, which lists the names, if there is none."""
    one_of(name, ISOTOPES, "isotope")
    return ISOTOPES[name]


def photon_energy(value: float | str) -> float:
    """Return a photon energy, keV, given as a number, its text, or the name of an isotope, whose strongest line is taken."""
    if value in ISOTOPES:
        return max(ISOTOPES[str(value)].lines, key=lambda line: line[1])[0]
    with expecting(f"energy {value!r}: expected keV, or one of {', '.join(ISOTOPES)}"):
        return float(value)
