"""Simulate a heart in a thorax with scattered photons, draw them, and reconstruct three ways.

    python examples/scatter.py [WORKBOOK [FOLDER]]

Prints how many photons of each energy window are scattered, and the mean activity of the heart's muscle and of the body
around it by each reconstruction; the first is told the scatter. Writes scatter.webp: photons that are not scattered,
scattered ones and all, and spectra.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import mphdrr.core as mph
from mphdrr.core.physics.energy_window import peak_shares
from mphdrr.core.runs.display import Display

WINDOWS = {"126 to 154 keV": (126.0, 154.0), "120 to 126 keV": (120.0, 126.0), "154 to 160 keV": (154.0, 160.0)}
WIDTHS = (6.0, 28.0, 6.0)
TILE, TEXT, MARGIN = 200, 26, 8
COLORS = ("#f9c932", "#5aaef0", "#f0805c", "#b3de69", "#bebada", "#fccde5")


def main(workbook: Path, folder: Path) -> None:
    """Simulate, print and draw."""
    system = mph.read_system(workbook)
    system = system[::4]
    torso = mph.CardiacTorso()
    grid = mph.Grid.centered((46, 34, 36), 8.0, (35.0, -30.0, 0.0))  # around the body: the heart is at the isocentre
    activity, mu = torso.voxelize(grid), torso.voxelize(grid, quantity="mu")
    physics = {"isotope": "Tc-99m", "energy_fwhm": 0.1, "crystal_mu": "NaI", "aperture_mu": "tungsten"}
    model = mph.Emission(system, mu=mu, time=600, **physics)
    views = system.views((32, 32), "real")
    A = mph.Projector(grid, views, model)

    primary = A(activity)
    found = mph.scatter_images(
        activity, mu, views, model, windows=list(WINDOWS.values()), precision=0.004, spectra=True
    )
    shares = peak_shares(model.isotope, (WINDOWS["120 to 126 keV"], model.window, WINDOWS["154 to 160 keV"]), 0.1)
    lower, peak, upper = (share / shares[1] for share in shares)
    for name, images, share in zip(WINDOWS, found.images, (peak, lower, upper), strict=True):
        scatter = images.sum() / (images.sum() + share * primary.sum())
        print(f"{name}: {scatter:.1%} of the photons are scattered")
    folder.mkdir(parents=True, exist_ok=True)
    picture(system, primary, found).save(folder / "scatter.webp", quality=88, method=6)
    print(folder / "scatter.webp")

    counts = [mph.sample_counts(images + share * primary, seed) for seed, (images, share) in enumerate(
        zip(found.images, (peak, lower, upper), strict=True))]  # fmt: skip
    by_windows, _ = mph.energy_window_scatter(counts[1], counts[0], counts[2], WIDTHS, 2.0, shares=shares)
    ways = {
        "the true scatter": {"background": found.images[0]},
        "no correction": {},
        "three windows": {"background": by_windows.clip(min=0)},
        "scatter in the body": {"scatter": "body"},
    }
    regions = {"heart": activity.array > 0.9 * torso.myocardium, "body": abs(activity.array - torso.body) < 0.01}
    for way, arguments in ways.items():
        volume = mph.osem(A, counts[0], 20, 2, **arguments).volume
        means = (f"{name} {volume.array[region].mean():.1f}" for name, region in regions.items())
        print(f"{way}: {', '.join(means)} kBq/mL")


def picture(system: mph.PinholeSystem, primary: np.ndarray, found: mph.ScatterImages) -> Image.Image:
    """Draw six modules' photons, and the spectra of those that are scattered."""
    chosen = np.linspace(0, len(system) - 1, 6).astype(int)
    rows = {"not scattered": primary, "scattered": found.images[0], "all": primary + found.images[0]}
    width = 6 * (TILE + MARGIN) + MARGIN
    page = Image.new("RGB", (width, 3 * (TILE + TEXT) + 340), (24, 26, 29))
    write, display = ImageDraw.Draw(page), Display("inferno")
    for row, (name, images) in enumerate(rows.items()):
        window = 0.0, float(images[chosen].max())
        write.text((MARGIN, row * (TILE + TEXT) + 7), f"{name}: 0 to {window[1]:.0f} counts", fill=(220, 222, 226))
        for column, m in enumerate(chosen):
            tile = Image.fromarray(display.colored(mph.as_seen(images[m]), window)).resize((TILE, TILE))
            page.paste(tile, (MARGIN + column * (TILE + MARGIN), row * (TILE + TEXT) + TEXT))
    top, height, left = 3 * (TILE + TEXT) + 30, 270, 60
    spectra, energies = found.spectra[chosen], found.energies
    kept = energies < 140  # photons that Rayleigh scattering leaves all their energy stand beside all others
    for color, m, spectrum in zip(COLORS, chosen, spectra, strict=True):
        heights = spectrum[kept] / spectra[:, kept].max()
        x = left + (energies[kept] - energies[0]) / (energies[-1] - energies[0]) * (width - 2 * left)
        write.line([*zip(x, top + height * (1 - heights), strict=True)], fill=color, width=2)
        write.text((left + 90 * list(chosen).index(m), top - 22), f"module {system.numbers[m]}", fill=color)
    for energy in range(40, 141, 20):
        x = left + (energy - energies[0]) / (energies[-1] - energies[0]) * (width - 2 * left)
        write.text((x - 20, top + height + 8), f"{energy} keV", fill=(150, 154, 160))
    return page


if __name__ == "__main__":
    workbook = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "dc-spect-80.xlsx"
    main(workbook, Path(sys.argv[2] if len(sys.argv) > 2 else "out/scatter"))
