"""Write core/physics/photon_scattering.txt: `pip install xraylib`, then `python tools/scattering_tables.py`.

xraylib is no dependency of the package.
"""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import xraylib

TABLE = Path(__file__).resolve().parents[1] / "core" / "physics" / "photon_scattering.txt"
ELEMENTS = ("H", "C", "N", "O", "Na", "Mg", "P", "S", "Cl", "Ar", "K", "Ca")  # of bodies
MOMENTA = np.geomspace(0.005, 100, 100)

HEAD = f"""\
# Scattering of photons by free atoms: a line of momentum transfers x = sin(theta / 2) / wavelength, 1/angstrom; then for
# each element its atomic weight A, its form factor F(x) and its incoherent scattering function S(x): Z and 0 at x = 0.
#
# Made by tools/scattering_tables.py with xraylib {version("xraylib")} (BSD): J. H. Hubbell et al., "Atomic form factors,
# incoherent scattering functions, and photon scattering cross sections", J. Phys. Chem. Ref. Data 4 (1975) 471-538.
"""


def main() -> None:
    """Write the table."""
    lines = ["x " + " ".join(f"{x:.5g}" for x in MOMENTA)]
    for symbol in ELEMENTS:
        z = xraylib.SymbolToAtomicNumber(symbol)
        lines.append(f"{symbol} A {xraylib.AtomicWeight(z):.6g}")
        for letter, function in (("F", xraylib.FF_Rayl), ("S", xraylib.SF_Compt)):
            values = (max(function(z, float(f"{x:.5g}")), 1e-7) for x in MOMENTA)  # splines end below 0
            lines.append(f"{symbol} {letter} " + " ".join(f"{value:.4g}" for value in values))
    TABLE.write_text(HEAD + "\n".join(lines) + "\n", encoding="ascii")


if __name__ == "__main__":
    main()
