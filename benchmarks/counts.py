"""What the accuracy of SPECT counts costs: rays of a pixel, time and error, 80 modules, as a table on standard output.

    python benchmarks/counts.py [WORKBOOK]

The error is that of the total counts of single voxels at random places, against the point law; the time that of the whole
volume (a Derenzo phantom) and of its adjoint, the best of two.
"""

from __future__ import annotations

import functools
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import mphdrr.core as mph

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
CASES = ((64, 2.0, 64), (128, 1.0, 128))  # voxels along an axis, mm, pixels along a side
MODELS: dict[str, dict[str, Any]] = {
    "whole hole, by depth": {},
    "its middle, automatic": {"hole": "point"},
    "its middle, 1 ray": {"hole": "point", "pixel_points": 1},
    "7 points of it, automatic": {"aperture_points": 7},
    "7 points of it, 1 ray each": {"aperture_points": 7, "pixel_points": 1},
}
PLACES = 12
ENOUGH = 5.0  # s


def best(call: Callable[[], Any]) -> float:
    """Return the seconds of the faster of two calls, or of a single one that takes long."""
    times: list[float] = []
    while len(times) < 2 and (not times or times[0] < ENOUGH):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return min(times)


def worst_error(system: mph.PinholeSystem, size: float, views: mph.Views, model: mph.Emission) -> float:
    """Return the largest relative error of the total counts in any module, of single voxels of `size` mm."""
    rng = np.random.default_rng(1)
    ticks, weights = np.array([-1, 0, 1]) * np.sqrt(0.15) * size, np.array([5, 8, 5]) / 18
    steps = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    share = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
    errors = []
    for place in rng.uniform(-35, 35, (PLACES, 3)):
        A = mph.Projector(mph.Grid.centered(1, size, place), views, model)
        counted = A(np.ones((1, 1, 1))).sum(axis=(1, 2), dtype=float)
        errors.append(np.abs(counted / (share @ mph.sensitivity(system, place + steps) * size**3) - 1).max())
    return float(max(errors))


def main() -> None:
    """Print the table of rays, times and errors."""
    warnings.simplefilter("ignore", mph.InputWarning)
    system = mph.read_system(sys.argv[1] if len(sys.argv) > 1 else WORKBOOK)
    print(
        "| voxels | pixels | hole and pixel | rays of a pixel | images s | adjoint s | a voxel's total off by up to |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for n, size, pixels in CASES:
        grid, views = mph.Grid.centered(n, size), system.views((pixels, pixels), "real")
        volume = mph.DerenzoPhantom(radius=40, rod_diameters=(8, 6, 5, 4, 3, 2), height=40).voxelize(grid)
        for name, options in MODELS.items():
            model = mph.Emission(system, **options)
            rays = [
                sum(len(b.rays.shifts) for b in model.beams(views, m, grid)) if options else 0
                for m in range(len(system))
            ]
            counted = f"{min(rays)} to {max(rays)}" if max(rays) > min(rays) else str(rays[0])
            error = worst_error(system, size, views, model)
            A = mph.Projector(grid, views, model)
            y = A(volume)
            images, adjoint = best(functools.partial(A, volume)), best(functools.partial(A.T, y))
            times = f"{images:.2f} | {adjoint:.2f}"
            print(
                f"| {n}^3 of {size:g} mm | {pixels}^2 | {name} | {counted} | {times} | {100 * error:.3g} % |",
                flush=True,
            )


if __name__ == "__main__":
    main()
