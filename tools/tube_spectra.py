"""Make core/xray/tube_spectra.txt with SpekPy: `pip install spekpy`, then `python tools/tube_spectra.py`.

SpekPy is no dependency of the package: 164 MB for a table of 75 kB.
"""

from importlib.metadata import version
from pathlib import Path

import spekpy

TABLE = Path(__file__).resolve().parents[1] / "core" / "xray" / "tube_spectra.txt"
ANGLE, STEP, LOWEST = 12, 0.5, 1.0
VOLTAGES = [*range(20, 40), *range(40, 151, 2)]  # linear interpolation between them is worst where the voltage is low

HEAD = f"""\
# Spectra of tungsten tubes with an anode of {ANGLE} degrees, before any filter but the anode itself: on the central axis at
# 1 m, without air, photons per mm^2 and mAs in steps of {STEP} keV from {LOWEST:g} keV up to kVp.
#
# Made by tools/tube_spectra.py with SpekPy {version("spekpy")} (MIT; G. Poludniowski, A. Omar, R. Bujila, P. Andreo, "SpekPy
# v2.0: a software toolkit for modeling x-ray tube spectra", Medical Physics 48 (2021) 3630-3637), its model "casim".
#
# A line: kVp, then the photons.
"""


def line(kvp: int) -> str:
    """Return one tube voltage's line of the table."""
    energies, per_cm2_and_kev = spekpy.Spek(kvp=kvp, th=ANGLE, dk=STEP, z=100, mas=1).get_spectrum()
    photons = per_cm2_and_kev[energies > LOWEST] * STEP / 100
    return " ".join([str(kvp), *(f"{value:.5g}" for value in photons)])


if __name__ == "__main__":
    TABLE.write_text(HEAD + "".join(line(kvp) + "\n" for kvp in VOLTAGES), encoding="ascii")
