"""How many of the counts in a window are scattered photons, by body and isotope: ``python -m benchmarks.scatter_fractions``.

20 of the example's modules, 32 x 32 pixels, tungsten; windows of 20 % around a line, or beneath it.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

import mphdrr.core as mph
from mphdrr.core.physics.energy_window import acceptance
from mphdrr.core.scatter.body import SCATTERERS, Body

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
CRYSTALS = {"NaI": 0.1, "CZT": 0.05}
"""Crystals and their energy resolution."""
ROWS = (
    ("Tc-99m", 140.5, (126.4, 154.6)),
    ("Tc-99m", 140.5, (114.0, 126.4)),
    ("I-123", 159.0, (143.1, 174.9)),
    ("In-111", 171.3, (154.2, 188.4)),
    ("In-111", 245.4, (220.9, 269.9)),
    ("I-131", 364.5, (328.1, 401.0)),
)
"""Isotopes, the energy of a line, and windows, keV."""


def bodies() -> dict[str, tuple[mph.Volume, Body]]:
    """Return the activities and the bodies: the torso, and a cylinder of water of 200 mm that is active all over."""
    grid, torso = mph.Grid.centered((48, 48, 40), 8.0), mph.CardiacTorso()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)  # the torso is longer than what the modules see
        activity, mu = torso.voxelize(grid), torso.voxelize(grid, quantity="mu")
    shape = mph.ShapePhantom([mph.Cylinder(radius=100, height=200, activity=10, mu=mph.attenuation("water", 140.5))])
    cylinder = shape.voxelize(grid), shape.voxelize(grid, quantity="mu")
    pairs = {"torso": (activity, mu), "cylinder": cylinder}
    return {name: (volume, Body.of(there, 140.5)) for name, (volume, there) in pairs.items()}


def main() -> None:
    """Print the table."""
    system = mph.read_system(WORKBOOK)[np.arange(0, 80, 4)]
    views = system.views((32, 32), "real")
    scanned = bodies()
    print(
        "| isotope | window, keV | "
        + " | ".join(f"{name}, {crystal}" for name in scanned for crystal in CRYSTALS)
        + " |"
    )
    print("|---" * (2 + len(scanned) * len(CRYSTALS)) + "|")
    for isotope, energy, window in ROWS:
        cells = []
        for activity, body in scanned.values():
            coefficients = [mph.attenuation(scatterer.material, energy) for scatterer in SCATTERERS]
            mu = mph.Volume(np.float32(body.densities @ coefficients), body.grid, "mu")
            for crystal, fwhm in CRYSTALS.items():
                physics = {"isotope": isotope, "window": (0.9 * energy, 1.1 * energy), "energy_fwhm": fwhm}
                model = mph.Emission(system, mu=mu, crystal_mu=crystal, aperture_mu="tungsten", **physics)
                scatter = mph.scatter_images(activity, mu, views, model, windows=[window], precision=0.01).images.sum()
                shares = [acceptance(energy, w, fwhm * energy) for w in (window, physics["window"])]
                primary = mph.Projector(activity.grid, views, model)(activity).sum() * shares[0] / shares[1]
                cells.append(f"{scatter / (scatter + primary):.1%}")
        print(f"| {isotope} | {window[0]:g} to {window[1]:g} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
