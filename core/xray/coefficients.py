"""Photon coefficients of materials at many energies, and the table of water in photon_data.txt."""

from functools import cache

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..physics.mass_attenuation import mass_attenuation, table_lines
from ..physics.materials import MATERIALS, attenuation
from ..validation import freeze

_SYMBOLS = {next(iter(m.composition)): name for name, m in MATERIALS.items() if len(m.composition) == 1}
"""Names of the materials that are elements, by their symbols."""


def attenuations(material: str, energies: Floats) -> Floats:
    """Return linear attenuation coefficients (n,), 1/mm, of a material at energies (n,), keV.

    `material` is a name of `MATERIALS` or an element such as "Al".
    """
    return _attenuations(_SYMBOLS.get(material, material), tuple(energies.tolist()))


@cache
def _attenuations(material: str, energies: tuple[float, ...]) -> Floats:
    """Return the coefficients (n,), 1/mm, of a name of `MATERIALS` or an element, read-only and cached."""
    return freeze(np.array([attenuation(material, energy) for energy in energies]))


def energy_absorption(material: str, energies: Floats) -> Floats:
    """Return mass energy-absorption coefficients (n,), cm^2/g, of "air" at 1, of "water" at 10 to 1000 keV."""
    if material == "air":
        return np.array([mass_attenuation("air-absorption", energy) for energy in energies.tolist()])
    return interpolate_log(energies, *photon_data()[:2])


@cache
def photon_data() -> Floats:
    """Return the columns (8, n) of photon_data.txt."""
    return table_numbers("photon_data.txt").T


def table_numbers(name: str) -> Floats:
    """Return the numbers of a text table in this folder (rows, columns); short rows are filled up with zeros."""
    rows = [line.split() for line in table_lines(name, __file__)]
    numbers = np.zeros((len(rows), max(map(len, rows))))
    for row, values in zip(numbers, rows, strict=True):
        row[: len(values)] = [float(value) for value in values]
    return freeze(numbers)


def interpolate_log(energies: Floats, table_energies: Floats, values: Floats) -> Floats:
    """Interpolate positive values at other energies: the cubic through the four nearest points, in logarithms of both.

    `values` belong to the ascending `table_energies`. Raises `InputError` for energies outside of them.
    """
    if energies.min() < table_energies[0] or energies.max() > table_energies[-1]:
        requested = f"energies {energies.min():g} to {energies.max():g} keV"
        raise InputError(f"{requested}: expected {table_energies[0]:g} to {table_energies[-1]:g} keV")
    nearest = np.clip(np.searchsorted(table_energies, energies) - 2, 0, len(table_energies) - 4)[:, None] + np.arange(4)
    x, nodes, y = np.log(energies)[:, None], np.log(table_energies)[nearest], np.log(values)[nearest]
    total = np.zeros(len(energies))
    for i in range(4):
        rest = [j for j in range(4) if j != i]
        total += y[:, i] * np.prod((x - nodes[:, rest]) / (nodes[:, i : i + 1] - nodes[:, rest]), axis=1)
    return np.exp(total)
