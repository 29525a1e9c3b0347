"""Mass attenuation coefficients of the elements, 1 to 1000 keV, from NIST's table in mass_attenuation.txt."""

from functools import cache
from pathlib import Path

import numpy as np

LOWEST_ENERGY, HIGHEST_ENERGY = 1.0, 1000.0
"""Range of the table's energies, keV."""

Point = tuple[float, float]
"""Energy, keV, and the coefficient at this energy, cm^2/g."""


@cache
def mass_attenuation(symbol: str, energy: float) -> float:
    """Return the mass attenuation coefficient, cm^2/g, of the element with this symbol at an energy, keV.

    The symbol "air-absorption" stands for the mass energy-absorption coefficient of air. Coefficients are interpolated by a
    cubic in the logarithms through the four nearest energies of the table that no absorption edge separates from `energy`;
    where they rise above an edge, with one energy up to the next edge, by a power law. At an edge it is the one above it.
    """
    points, edges = table()[symbol]
    first = [(edge, above) for edge, _, above in edges if edge <= energy][-1:]
    last = [(edge, below) for edge, below, _ in edges if edge > energy][:1]
    low, high = first[0][0] if first else 0.0, last[0][0] if last else np.inf
    energies, values = np.array([*first, *(point for point in points if low < point[0] < high), *last]).T
    count = min(4, len(energies)) if len(energies) != 3 or values[1] < values[0] else 2
    start = np.clip(np.searchsorted(energies, energy) - count // 2, 0, len(energies) - count)
    nearest = slice(start, start + count)
    curve = np.polyfit(np.log(energies[nearest] / energy), np.log(values[nearest]), count - 1)
    return float(np.exp(curve[-1]))  # the cubic's value at log(1)


def table_lines(name: str, beside: str = __file__) -> list[str]:
    """Read the lines of a text table in the folder of the file `beside`, without its comments."""
    text = Path(beside).with_name(name).read_text(encoding="ascii")
    return [line for line in text.splitlines() if not line.startswith("#")]


@cache
def table() -> dict[str, tuple[list[Point], list[tuple[float, float, float]]]]:
    """Read the table: by symbol the element's points, and its absorption edges: energy, coefficient below and above."""
    elements: dict[str, tuple[list[Point], list[tuple[float, float, float]]]] = {}
    energies: list[float] = []
    for name, *values in map(str.split, table_lines("mass_attenuation.txt")):
        if name == "keV":
            energies = [float(x) for x in values]
        elif values[0] == "edge":
            energy, below, above = (float(x) for x in values[1:])
            elements[name][1].append((energy, below, above))
        else:
            elements[name] = (list(zip(energies, map(float, values), strict=True)), [])
    return elements
