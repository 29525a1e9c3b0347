"""What calibration is worth: a scanner whose modules are not where its workbook has them, calibrated with eight points.

    python calibrate_scanner.py [scanner.xlsx] [--picture calibration.png] [--modules 80] [--voxels 64]

The true scanner's pinholes are 1 mm off along each axis and its modules tilted by 0.5 degrees (standard deviations). Eight
points make about 20 000 counts each in each module; nobody knows where the points are. Then the true scanner sees rods, and
three reconstructions differ only in the geometry that they are told: nominal, calibrated and true.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import mphdrr.core as mph
from mphdrr.core.figures.page import Page
from mphdrr.core.figures.parts import INK
from mphdrr.core.runs.display import Display

WORKBOOK = Path(__file__).with_name("dc-spect-80.xlsx")
PHYSICS = {"isotope": "Tc-99m", "aperture_mu": "tungsten", "crystal_mu": "NaI", "intrinsic_fwhm": 1.0}
DEPTH = {"depth_layers": 5}  # the points' photons stop in the depth of the crystal


def main() -> None:
    """Simulate the misaligned scanner, calibrate it, and print and draw the reconstructions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workbook", nargs="?", default=WORKBOOK, help="the scanner's geometry workbook")
    parser.add_argument("--picture", default="calibration.png", help="file for a slice of each reconstruction")
    parser.add_argument("--modules", type=int, default=80, help="how many of the scanner's")
    parser.add_argument("--voxels", type=int, default=48, help="of the reconstructions, along a side of 90 mm")
    parser.add_argument("--pixels", type=int, default=64, help="of a module's image, along a side")
    parser.add_argument("--iterations", type=int, default=12)
    arguments = parser.parse_args()
    began = time.perf_counter()

    # The workbook's scanner, and the true one.
    rng = np.random.default_rng(1)
    whole = mph.read_system(arguments.workbook)
    nominal = whole[np.linspace(0, len(whole) - 1, min(arguments.modules, len(whole))).round().astype(int)]
    shifts, tilts = rng.normal(0, 1.0, (2, len(nominal), 3))
    true = nominal.replace(centers=nominal.centers + shifts, tilt=np.radians(0.5) * tilts)
    shape = arguments.pixels, arguments.pixels

    # Eight acquisitions of a point source each, and the calibration by them.
    corners = np.array([[x, y, z] for x in (-40.0, 40.0) for y in (-40.0, 40.0) for z in (-40.0, 40.0)])
    points = corners + rng.normal(0, 3.0, corners.shape)
    model = mph.Emission(true, **PHYSICS, **DEPTH)
    expected = mph.point_images(model, true.views(shape), points)
    images = rng.poisson(expected * 20_000 / expected.sum((2, 3)).mean())
    found = mph.calibrate(nominal, images, nominal.views(shape), model=mph.Emission(nominal, **PHYSICS, **DEPTH))
    print(f"calibrated in {time.perf_counter() - began:.1f} s: chi-square {np.nanmean(found.chi_square):.3f}")
    for name, sd in zip(found.names, np.sqrt((found.spread**2).mean(axis=0)), strict=True):
        print(
            f"  {name:10s} known to " + (f"{np.degrees(sd):.3f} degrees" if name.startswith("tilt") else f"{sd:.3f} mm")
        )

    # A scan of rods by the true scanner, reconstructed with three geometries.
    phantom = mph.DerenzoPhantom(35, (10, 8, 7, 6, 5, 4), 35, activity=100)
    pose = mph.euler_pose(*np.radians([30, 55, 0]))  # modules see along and across the rods
    fine = mph.Grid.centered(2 * arguments.voxels, 45 / arguments.voxels)
    scan = mph.Emission(true, time=600, **PHYSICS)
    counts = mph.sample_counts(mph.Projector(fine, true.views(shape), scan)(phantom.voxelize(fine, pose)), seed=2)
    grid = mph.Grid.centered(arguments.voxels, 90 / arguments.voxels)
    truth = phantom.voxelize(grid, pose)
    volumes = {"truth": truth}
    for name, system in (("nominal", nominal), ("calibrated", found.system), ("true geometry", true)):
        A = mph.Projector(grid, system.views(shape), mph.Emission(system, time=600, **PHYSICS))
        volumes[name] = mph.osem(A, counts, arguments.iterations, subsets=16).volume
        print(f"{name}: NRMSE {mph.nrmse(volumes[name], truth):.4f}, {time.perf_counter() - began:.0f} s")
    draw(volumes, truth, pose).write(arguments.picture)


def draw(volumes: dict[str, mph.Volume], truth: mph.Volume, pose: np.ndarray) -> Page:
    """Draw the slices across the rods, side by side, in the same colors."""
    plane = mph.Grid.centered((160, 160, 1), 0.5)
    across = mph.Grid(plane.shape, pose @ plane.affine)
    display, side, gap = Display(colors="inferno"), 300, 20
    page = Page(len(volumes) * (side + gap) + gap, side + 3 * gap)
    window = 0.0, 1.0 * float(truth.array.max())
    for i, (name, volume) in enumerate(volumes.items()):
        picture = mph.resample(volume, across).array[:, :, 0].T[::-1]
        left = gap + i * (side + gap)
        page.image(display.colored(picture, window), left, 2 * gap, side, side)
        score = "" if volume is truth else f", NRMSE {mph.nrmse(volume, truth):.3f}"
        page.text(f"{name}{score}", left + side / 2, 1.4 * gap, 15, INK, "middle")
    return page


if __name__ == "__main__":
    main()
