"""From a scanner's workbook to a scored reconstruction: simulate a scan of a Derenzo phantom and reconstruct it.

    python reconstruct.py [scanner.xlsx] [--picture reconstruction.png] [--iterations 8] [--voxels 64]

The data come from voxels less than half as large as those of the reconstruction, and from rays through the hole, which the
reconstruction's model does without: with the same ones, model and data would share their errors, and the scores would
flatter.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import mphdrr.core as mph
from mphdrr.core.figures.page import DARK, Page
from mphdrr.core.figures.reconstructions import SIZE_BESIDE_TRUTH, draw

WORKBOOK = Path(__file__).with_name("dc-spect-80.xlsx")


def main() -> None:
    """Simulate the scan, reconstruct it, print the scores and draw the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workbook", nargs="?", default=WORKBOOK, help="the scanner's geometry workbook")
    parser.add_argument("--picture", default="reconstruction.png", help="file for slices, truth and objective")
    parser.add_argument("--iterations", type=int, default=8)
    parser.add_argument("--subsets", type=int, default=16)
    parser.add_argument("--voxels", type=int, default=64, help="of the reconstruction, along a side of 102 mm")
    parser.add_argument("--pixels", type=int, default=64, help="of a module's image, along a side")
    parser.add_argument("--fine", type=int, default=160, help="voxels of the data, along the same side")
    arguments = parser.parse_args()
    began = time.perf_counter()

    # The scanner and the scan: 10 minutes of Tc-99m in rods of 8 to 2 mm.
    system = mph.read_system(arguments.workbook)
    views = system.views(shape=(arguments.pixels, arguments.pixels), detector="real")
    phantom = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, activity=100)
    physics = {
        "time": 600, "isotope": "Tc-99m", "aperture_mu": "tungsten", "crystal_mu": "NaI", "intrinsic_fwhm": 1.0
    }  # fmt: skip

    # The data: from fine voxels, many rays and with noise.
    side = 102.4  # mm
    fine = mph.Grid.centered(arguments.fine, side / arguments.fine)
    truth = phantom.voxelize(fine)
    scan = mph.Emission(system, aperture_points=19, pixel_points=4, tolerance=1e9, **physics)
    counts = mph.sample_counts(mph.Projector(fine, views, scan)(truth), seed=1)
    print(f"{counts.sum():.4g} counts in {len(views)} images, {time.perf_counter() - began:.1f} s")

    # The model: coarser voxels, and the blur of the whole hole, depth by depth.
    grid = mph.Grid.centered(arguments.voxels, side / arguments.voxels)
    A = mph.Projector(grid, views, mph.Emission(system, **physics))

    def say(iteration: int, values: object) -> None:
        print(f"iteration {iteration} of {arguments.iterations}, {time.perf_counter() - began:.1f} s")

    result = mph.osem(A, counts, arguments.iterations, arguments.subsets, callback=say)

    # The scores: how far the values are off, and which rods are told from their neighbours.
    score = mph.score_volume(result.volume, phantom)
    print(*score.lines, sep="\n")

    page = Page(*SIZE_BESIDE_TRUTH, DARK)
    lines = [f"{result.iterations} iterations, {arguments.subsets} subsets, NRMSE {score.nrmse:.3f}"]
    rods = [sector.cells for sector in score.derenzo or () if sector.rod_diameter]
    draw(page, result.volume, result.objective.tolist(), truth, "OSEM of a Derenzo phantom", lines, rods=rods)
    page.write(arguments.picture)
    print(f"{arguments.picture}, {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    main()
