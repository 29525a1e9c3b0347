"""Write the radiations of core/physics/isotopes.txt: `pip install icrp107-database`, then `python tools/photon_lines.py`.

Names and half-lives stay as they are in the table: an isotope is added by a line with these two. icrp107-database is no
dependency of the package.
"""

import json
from importlib.metadata import distribution
from pathlib import Path

TABLE = Path(__file__).resolve().parents[1] / "core" / "physics" / "isotopes.txt"
SOURCE = distribution("icrp107-database")  # found, not imported: that needs numpy
LOWEST = 10.0  # keV: softer photons are absorbed where they are emitted
WEAKEST = 0.005  # photons per decay: weaker lines are not counted
GROUP = 1.05  # weak lines up to this factor in energy stand together
NEGLIGIBLE = 2e-4  # share of the photons' energy up to which a group of weak lines is left out

HEAD = f"""\
# Isotopes: name, half-life, mean energy of electrons (beta, conversion and Auger electrons) and of photons below
# {LOWEST:g} keV, keV per decay; then energy, keV, and photons per decay of each line, by energy: gamma rays, x rays and
# annihilation photons of more than {WEAKEST:.1%} of the decays; after "weak" those of the weaker lines, which stand
# together at their mean energy if they are up to {GROUP - 1:.0%} apart, and are left out if they then carry less than
# {NEGLIGIBLE:.2%} of the photons' energy. Photons per decay are rounded to three digits.
#
# Made by tools/photon_lines.py with icrp107-database {SOURCE.version} (LGPL 3): ICRP Publication 107, "Nuclear Decay
# Data for Dosimetric Calculations", Annals of the ICRP 38 (3) (2008). Half-lives: ENSDF, the Evaluated Nuclear Structure
# Data File of the National Nuclear Data Center, Brookhaven (nndc.bnl.gov/ensdf), as distributed with paceENSDF 0.6.3.
#
# Evaluations differ: by as much as 3 % (Xe-133's 81 keV: 0.369 to 0.380), and 6 % of Lu-177's 208 keV (0.104 to 0.110).
"""


def radiations(name: str) -> str:
    """Return what the table says of an isotope behind its half-life."""
    path = Path(str(SOURCE.locate_file(f"icrp107_database/icrp107/{name}.json")))
    emissions = json.loads(json.loads(path.read_text(encoding="utf-8")))[
        "emissions"
    ]  # a text in JSON that is JSON, too

    def lines(*kinds: str) -> list[tuple[float, float]]:
        """Return energies, keV, and numbers per decay of radiations, by energy."""
        return sorted((1000 * energy, number) for kind in kinds for energy, number in emissions.get(kind, ()))

    def per_decay(radiation: list[tuple[float, float]]) -> float:
        """Return keV per decay."""
        return sum(energy * number for energy, number in radiation)

    photons = lines("gamma", "X", "annihilation")
    groups: list[list[tuple[float, float]]] = []
    for line in photons:
        if line[0] >= LOWEST and line[1] <= WEAKEST:
            groups = groups if groups and line[0] <= GROUP * groups[-1][0][0] else [*groups, []]
            groups[-1].append(line)
    weak = [(per_decay(group) / sum(n for _, n in group), sum(n for _, n in group)) for group in groups]
    weak = [line for line in weak if per_decay([line]) >= NEGLIGIBLE * per_decay(photons)]
    strong = [line for line in photons if line[0] >= LOWEST and line[1] > WEAKEST]
    words = [
        f"{per_decay(lines('beta-', 'beta+', 'auger', 'IE')):.4g}",
        f"{per_decay([line for line in photons if line[0] < LOWEST]):.3g}",
        *(f"{energy:.4g} {number:.{4 if number > 1 else 3}g}" for energy, number in strong),
        *(["weak"] if weak else []),
        *(f"{energy:.4g} {number:.3g}" for energy, number in weak),
    ]
    return "  ".join(words)


if __name__ == "__main__":
    rows = [line.split()[:3] for line in TABLE.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    table = "".join(f"{' '.join(row)}  {radiations(row[0])}\n" for row in rows)
    TABLE.write_text(HEAD + table, encoding="ascii")
