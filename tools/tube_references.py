"""Make tests/core/data/tube_references.txt with SpekPy: `pip install spekpy`, then `python tools/tube_references.py`."""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import spekpy

TABLE = Path(__file__).resolve().parents[1] / "tests" / "core" / "data" / "tube_references.txt"
VOLTAGES = (20, 21, 35, 50, 80, 120, 150)
FILTERS = ("", "Al 0.1", "Al 0.3", "Al 0.5", "Al 1", "Al 3", "Be 0.5", "Be 3", "Cu 0.1", "Cu 0.3", "Cu 1", "Cu 3", "Sn 0.1",
           "Sn 0.3", "Sn 1", "Sn 3", "W 0.05", "W 0.1", "W 0.3", "W 1", "Al 1 + Sn 0.3")  # fmt: skip

HEAD = f"""\
# Tungsten tubes of 12 degrees at 1 m, as tools/tube_references.py finds them with SpekPy {version("spekpy")}.
#
# A line: kVp, then first and second half-value layer, mm Al, mean energy, keV, and air kerma, uGy/mAs, with SpekPy's own
# coefficients (PENELOPE), the same with those of NIST as SpekPy interpolates them, then the filters, mm.
"""


def values(kvp: int, filters: str, source: str) -> list[float]:
    """Return half-value layers, mean energy and air kerma of SpekPy's spectrum with coefficients "pene" or "nist"."""
    tube = spekpy.Spek(kvp=kvp, th=12, dk=0.5, z=100, mas=1, mu_data_source=source)
    for filter_ in filter(None, filters.split(" + ")):
        material, mm = filter_.split()
        tube.filter(material, float(mm))
    energies, photons = tube.get_spectrum()
    mu = tube.mu_data.get_mu_over_rho(13, energies) * 2.699 / 10
    kerma = photons * energies * tube.muen_air_data.get_muen_over_rho_air(energies)

    def layer(share: float) -> float:
        """Return the aluminum, mm, that leaves this share of the kerma; SpekPy's own search is rough in thin layers."""
        low, high = 0.0, -np.log(share) / mu.min()
        for _ in range(60):
            trial = (low + high) / 2
            low, high = (trial, high) if kerma @ np.exp(-mu * trial) > share * kerma.sum() else (low, trial)
        return high

    return [layer(0.5), layer(0.25) - layer(0.5), tube.get_emean(), tube.get_kerma()]


if __name__ == "__main__":
    rows = []
    for kvp in VOLTAGES:
        least = 1e-3 * values(kvp, "Al 1", "pene")[3]  # what passes thicker filters is nothing to compare
        for filters in FILTERS:
            own = values(kvp, filters, "pene")
            if own[3] > least:
                numbers = [*own, *values(kvp, filters, "nist")]
                rows.append(" ".join([str(kvp), *(f"{value:.5g}" for value in numbers), filters]))
    TABLE.write_text(HEAD + "\n".join(rows) + "\n", encoding="ascii")
