"""Add coefficients below 10 keV, and elements, to core/physics/mass_attenuation.txt.

`pip install spekpy`, then `python tools/soft_coefficients.py`.

They are NIST's XCOM as SpekPy brings it along (data/tables/nist_mu.dat), and NIST's energy absorption of air. What the table
has from 10 keV on stays as it is.
"""

import json
from pathlib import Path

import numpy as np
import spekpy

TABLE = Path(__file__).resolve().parents[1] / "core" / "physics" / "mass_attenuation.txt"
TABLES = Path(spekpy.__file__).with_name("data") / "tables"
NAMES = "H Be C N O Na Mg Al Si P S Cl Ar K Ca Fe Cu Zn Ga Ge Y Cd Sn Te I Cs Gd Lu W Au Pb Bi U"
ATOMIC = (1, 4, 6, 7, 8, *range(11, 21), 26, *range(29, 33), 39, 48, 50, 52, 53, 55, 64, 71, 74, 79, 82, 83, 92)
NUMBERS = dict(zip(NAMES.split(), ATOMIC, strict=True))
AIR = "air-absorption"
NODES = [1.0, 1.5, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 400, 500, 600, 800, 1000]


def nist(name: str) -> tuple[list[float], list[float]]:
    """Return SpekPy's energies, keV, and coefficients, cm^2/g, of an element or of air's energy absorption."""
    if name == AIR:
        data = json.loads((TABLES / "nist_muen_air.dat").read_text())
        energies, values = data["photon energy"], data["muen_over_rho_air"]
    else:
        data = json.loads((TABLES / "nist_mu.dat").read_text())
        energies, values = (data[key][NUMBERS[name] - 1] for key in ("photon energy", "mu_over_rho"))
    return [round(1000 * energy, 6) for energy in energies], values


def lines(name: str, old: dict[str, list[str]]) -> list[str]:
    """Return an element's lines of the table: coefficients at `NODES`, then its edges, ascending."""
    energies, values = nist(name)
    by_energy = dict(zip(energies, values, strict=True))
    kept = old.get(name, [])
    known = dict(zip(NODES[-17:], kept[0].split()[-17:], strict=True)) if kept else {}
    row = " ".join([name, *(known.get(energy, f"{by_energy[energy]:.4g}") for energy in NODES)])
    # The file has two energies for an edge, 1 eV apart or less.
    pairs = [i for i, gap in enumerate(np.diff(energies)) if gap < 0.0015 and values[i + 1] > values[i]]
    for (
        i
    ) in pairs:  # a node that is as good as on an edge gives the edge's coefficient, or rounding would set the slope
        near = [energy for energy in NODES if 0 < energy - energies[i] < 0.0015]
        values[i + 1] = by_energy[near[0]] * (near[0] / energies[i]) ** 2.5 if near else values[i + 1]
    edges = [f"{name} edge {energies[i]:g} {values[i]:.4g} {values[i + 1]:.5g}" for i in pairs]
    hard = [line for line in kept[1:] if float(line.split()[2]) > 10]
    return [row, *(edge for edge in edges if float(edge.split()[2]) < 10 or not kept), *hard]


if __name__ == "__main__":
    text = TABLE.read_text(encoding="ascii").splitlines()
    old: dict[str, list[str]] = {}
    for line in text:
        if not line.startswith(("#", "keV")):
            old.setdefault(line.split()[0], []).append(line)
    head = [line for line in text if line.startswith("#")]
    body = [line for name in [*NUMBERS, AIR] for line in lines(name, old)]
    keV = " ".join(["keV", *(f"{energy:g}" for energy in NODES)])
    TABLE.write_text("\n".join([*head, keV, *body]) + "\n", encoding="ascii")
