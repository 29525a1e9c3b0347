"""Bias by scatter in the body, by its correction: the study of docs/scatter.md and docs/reconstruction.md.

    python -m benchmarks.scatter_correction [DRAWS]

A torso with a hot lesion in 8 mm voxels and 16 modules of wide holes around it, for 60 s: few and coarse, so that ten draws
take minutes. Scatter in the counts is simulated by itself, with another seed and more histories than estimates have.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import mphdrr.core as mph
from mphdrr.core.physics.energy_window import peak_shares

CENTER = np.array([35.0, -30.0, 0.0])  # of the body between the modules, mm
LESION = np.array([70.0, -80.0, 10.0])
ITERATIONS, SUBSETS = 10, 8


class Study:
    """Counts of the torso, and regions in which reconstructions of them are compared."""

    def __init__(self, modules: int = 16, voxel: float = 8.0, pixels: int = 20, precision: float = 0.0025) -> None:
        turn = np.arange(modules) * 2.4  # rad, the golden angle
        sides = [230 * np.cos(turn), 230 * np.sin(turn), 60.0 * (np.arange(modules) % 3 - 1)]
        system = mph.PinholeSystem(CENTER + np.stack(sides, axis=1), 6.0, 110.0, 200.0, 9.0, 80.0)
        shape = tuple(int(n) for n in np.array([336, 240, 224]) // voxel)
        grid, views, torso = (
            mph.Grid.centered(shape, voxel, CENTER),
            system.views((pixels, pixels), "real"),
            mph.CardiacTorso(),
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", mph.InputWarning)  # the torso is longer than what the modules see
            activity, mu = torso.voxelize(grid), torso.voxelize(grid, quantity="mu")
        places = np.moveaxis(np.indices(shape), 0, -1) @ grid.affine[:3, :3].T + grid.affine[:3, 3]
        near = np.linalg.norm(places - LESION, axis=-1)
        inside = (abs(places - CENTER) < [140, 90, 60]).all(axis=-1)
        self.regions = {
            "heart": activity.array > 0.8 * torso.myocardium,
            "lesion": near < 18,
            "background": (abs(activity.array - torso.body) < 0.01) & inside & (near > 35),
        }
        activity = mph.Volume(np.where(near < 18, 60, activity.array).astype(np.float32), grid, "activity")
        model = mph.Emission(
            system, isotope="Tc-99m", energy_fwhm=0.1, crystal_mu="NaI", aperture_mu="tungsten", mu=mu, time=60
        )
        self.A = mph.Projector(grid, views, model)
        low, high = model.window
        windows = ((low, high), (low - 6, low), (high, high + 6))
        scatter = mph.scatter_images(activity, mu, views, model, windows=windows, precision=precision, seed=99).images
        self._widths = (6.0, high - low, 6.0)
        self._shares = peak_shares(model.isotope, (windows[1], windows[0], windows[2]), 0.1)
        lower, peak, upper = (share / self._shares[1] for share in self._shares)
        self.primary, self.scatter = self.A(activity), scatter[0]
        self._expected = [
            self.primary * share + images for share, images in zip((peak, lower, upper), scatter, strict=True)
        ]

    def counts(self, draw: int) -> list[Any]:
        """Return a draw of the counts in the peak, the lower and the upper window."""
        return [mph.sample_counts(images, 10 * draw + w) for w, images in enumerate(self._expected)]

    def by_windows(self, peak: Any, lower: Any, upper: Any, fwhm: float | None = None) -> Any:
        """Return the scatter by the triple energy window's formula, without the peak's tails."""
        images, _ = mph.energy_window_scatter(lower, peak, upper, self._widths, fwhm, shares=self._shares)
        return images.clip(min=0)

    def values(self, found: mph.Reconstruction) -> list[float]:
        """Return the mean activity in each region, kBq/mL."""
        return [float(found.volume.array[region].mean()) for region in self.regions.values()]

    def reconstruct(self, peak: Any, **arguments: Any) -> mph.Reconstruction:
        """Return the reconstruction of counts by OSEM."""
        return mph.osem(self.A, peak, ITERATIONS, SUBSETS, **arguments)


WAYS: dict[str, Callable[..., mph.Reconstruction]] = {
    "true scatter as background": lambda study, peak, *_: study.reconstruct(peak, background=study.scatter),
    'scatter="body"': lambda study, peak, *_: study.reconstruct(peak, scatter="body"),
    "three windows": lambda study, *windows: study.reconstruct(windows[0], background=study.by_windows(*windows)),
    "three windows, smoothed by 2 pixels": lambda study, *windows: study.reconstruct(
        windows[0], background=study.by_windows(*windows, fwhm=2.0)
    ),
    "no correction": lambda study, peak, *_: study.reconstruct(peak),
}


def compare(study: Study, draws: int, ways: Any = tuple(WAYS)) -> dict[str, tuple[Any, float]]:
    """Return the activities (draws, regions) by each way, and the seconds of a reconstruction."""
    found = {}
    for way in ways:
        begun = time.perf_counter()
        values = np.array([study.values(WAYS[way](study, *study.counts(draw))) for draw in range(draws)])
        found[way] = values, (time.perf_counter() - begun) / draws
    return found


def main() -> None:
    """Print the table."""
    study = Study()
    print(f"scatter: {study.scatter.sum() / study.primary.sum():.1%} of the primary counts ({study.primary.sum():.3g})")
    found = compare(study, int(sys.argv[1]) if len(sys.argv) > 1 else 10)
    true, _ = next(iter(found.values()))
    print("| scatter | " + " | ".join(study.regions) + " | s |\n|" + " --- |" * (len(study.regions) + 2))
    for way, (values, seconds) in found.items():
        cells = (f"{100 * bias:+.1f} ± {100 * sd:.1f} %" for bias, sd in zip(
            values.mean(axis=0) / true.mean(axis=0) - 1, values.std(axis=0, ddof=1) / true.mean(axis=0), strict=True
        ))  # fmt: skip
        print(f"| {way} | " + " | ".join(cells) + f" | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
