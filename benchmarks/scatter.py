"""What scattered photons of a thorax cost, beside the exact projector: ``python benchmarks/scatter.py [PRECISION]``.

All 80 modules, 64^2 pixels, a torso of 64^3 voxels of 6 mm, Tc-99m. Each line is a process of its own, whose peak of
memory is told above what it had before. Patches are pixels that together cover 10 mm at the isocentre.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import mphdrr.core as mph

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
PATCH = 10.0  # mm
HEAD = ("threads", "s", "processor s", "projector s", "times the projector", "histories", "worst module, SD %",
        "mean of modules, SD %", "patches of 10 mm, SD %", "memory MB")  # fmt: skip


def measure(threads: int, precision: float) -> list[float]:
    """Return the numbers of a line of the table."""
    system = mph.read_system(WORKBOOK)
    views, grid, torso = system.views((64, 64), "real"), mph.Grid.centered(64, 6.0), mph.CardiacTorso()
    activity, mu = torso.voxelize(grid), torso.voxelize(grid, quantity="mu")
    physics = {"isotope": "Tc-99m", "aperture_mu": "tungsten", "crystal_mu": "CZT", "energy_fwhm": 0.05}
    model = mph.Emission(system, time=600.0, mu=mu, **physics)
    A = mph.Projector(grid, views, model, threads=threads)
    A(activity)
    started = time.perf_counter()
    A(activity)
    projector = time.perf_counter() - started
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started, processor = time.perf_counter(), time.process_time()
    found = mph.scatter_images(activity, mu, views, model, precision=precision, threads=threads)
    seconds, processor = time.perf_counter() - started, time.process_time() - processor
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    pixel = np.sqrt(np.linalg.norm(np.cross(views.u_steps, views.v_steps), axis=1))
    centers = np.linalg.norm(system.centers, axis=1)
    length = np.linalg.norm(views.detector_centers - views.sources, axis=1)
    patch = np.maximum(np.round(PATCH * length / centers / pixel), 1)  # pixels along a side of 10 mm at the isocentre
    images, variances = found.images[0], found.deviation[0] ** 2
    errors = []
    for image, variance, n in zip(images, variances, patch.astype(int), strict=True):
        k = 64 // n * n
        blocks = [a[:k, :k].reshape(k // n, n, k // n, n).sum(axis=(1, 3)) for a in (image, variance)]
        bright = blocks[0] > blocks[0].mean()
        errors.append(np.sqrt(np.mean(blocks[1][bright] / blocks[0][bright] ** 2)))
    worst, mean = 100 * found.precision[0].max(), 100 * found.precision[0].mean()
    ratio = seconds / projector
    return [
        threads, seconds, processor, projector, ratio, found.histories, worst, mean, 100 * float(np.mean(errors)), memory
    ]  # fmt: skip


def main() -> None:
    """Print the table, a line for one and for two threads."""
    if sys.argv[1:2] == ["--line"]:
        print(json.dumps([float(x) for x in measure(int(sys.argv[2]), float(sys.argv[3]))]))
        return
    precision = sys.argv[1] if len(sys.argv) > 1 else "0.005"
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
    for threads in ("1", "2"):
        command = [sys.executable, __file__, "--line", threads, precision]
        line = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        print("| " + " | ".join(f"{x:.0f}" if x > 1000 else f"{x:.3g}" for x in line) + " |", flush=True)


if __name__ == "__main__":
    main()
