"""Coefficients of materials at many energies, and tables of air and water: photon_data.txt."""

from functools import cache
from pathlib import Path

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..physics.materials import MATERIALS, attenuation
from ..validation import freeze

_SYMBOLS = {next(iter(made.composition)): name for name, made in MATERIALS.items() if len(made.composition) == 1}
"""Materials that are elements, by their symbols."""


def attenuations(material: str, energies: Floats) -> Floats:
    """Linear attenuation coefficients (n,), 1/mm, of one of `MATERIALS`, or an element such as "Al", at energies, keV."""
    return _attenuations(_SYMBOLS.get(material, material), tuple(energies.tolist()))


@cache
def _attenuations(material: str, energies: tuple[float, ...]) -> Floats:
    return freeze(np.array([attenuation(material, energy) for energy in energies]))


def energy_absorption(material: str, energies: Floats) -> Floats:
    """Mass energy-absorption coefficients (n,), cm^2/g, of "air" or "water" at energies (n,), keV, of 10 to 1000."""
    table = photon_data()
    return between(energies, table[0], table[1 if material == "air" else 2])


@cache
def photon_data() -> Floats:
    """The columns (9, n) of photon_data.txt."""
    return table_numbers("photon_data.txt").T


def table_numbers(name: str) -> Floats:
    """The numbers of a table in this folder, row by row, with zeros where a row is shorter than others."""
    rows = [line.split() for line in table_lines(name)]
    numbers = np.zeros((len(rows), max(map(len, rows))))
    for row, values in zip(numbers, rows, strict=True):
        row[: len(values)] = [float(value) for value in values]
    return freeze(numbers)


def table_lines(name: str) -> list[str]:
    """The lines of a table in this folder, without its comments."""
    text = Path(__file__).with_name(name).read_text(encoding="ascii")
    return [line for line in text.splitlines() if not line.startswith("#")]


def between(energies: Floats, known: Floats, values: Floats) -> Floats:
    """Positive `values` at `known` energies, at others: a cubic in the logarithms through the four nearest."""
    if energies.min() < known[0] or energies.max() > known[-1]:
        given = f"energies {energies.min():g} to {energies.max():g} keV"
        raise InputError(f"{given}: expected {known[0]:g} to {known[-1]:g} keV")
    first = np.clip(np.searchsorted(known, energies) - 2, 0, len(known) - 4)[:, None] + np.arange(4)
    x, at, y = np.log(energies)[:, None], np.log(known)[first], np.log(values)[first]
    total = np.zeros(len(energies))
    for i in range(4):
        others = [j for j in range(4) if j != i]
        total += y[:, i] * np.prod((x - at[:, others]) / (at[:, i : i + 1] - at[:, others]), axis=1)
    return np.exp(total)
