"""80 radiographs of a CT, one from each module: through our DiffDRR face, one call each; by `Projector`; by DiffDRR itself.

    python benchmarks/drrs.py [--voxels 512 512 133] [--pixels 250]

The calls are those of docs/from-your-notebook.md. The CT is an ellipsoid of soft tissue in air. The first call of each does
not count. DiffDRR gets 4 of the 80, 4096 rays at a time, and its time is scaled.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from beside import tell

import mphdrr.core as mph
from mphdrr.core import diffdrr as face

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"


def timed(call: Callable[[int], Any], modules: range) -> float:
    """Return the seconds of all 80 modules' calls, after one to warm up; scaled from the modules that are called."""
    call(modules[-1])
    begun = time.perf_counter()
    for module in modules:
        call(module)
    return (time.perf_counter() - begun) * 80 / len(modules)


def main() -> None:
    """Print and record the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--voxels", type=int, nargs=3, default=(512, 512, 133))
    parser.add_argument("--pixels", type=int, default=250)
    asked = parser.parse_args()
    system = mph.read_system(WORKBOOK)
    shape, spacing = tuple(asked.voxels), np.array((360.0, 360.0, 332.5)) / asked.voxels
    pitch, distances = 500.0 / asked.pixels, 10 * system.collimator_length
    x, y, z = system.centers.T
    alpha, beta = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij", sparse=True)
    hu = np.where(1.6 * x**2 + 2.9 * y**2 < 1, 100 * np.sin(9 * x + 7 * y + 5 * z), -1000).astype(np.float32)
    ours = face.DRR(hu, spacing.tolist(), sdr=450.0, height=asked.pixels, delx=pitch)
    density, middle = ours.density.numpy(), torch.tensor(np.array(shape)[None] * spacing / 2)

    def by_face(module: int) -> None:
        ours.set_intrinsics_(sdd=float(distances[module]))
        angles = torch.tensor([[alpha[module], beta[module], torch.pi / 2]])
        ours(angles, middle, parameterization="euler_angles", convention="ZYX")

    views = mph.c_arm_views(system, shape=(asked.pixels, asked.pixels), pitch=pitch, elevation="diffdrr")
    seconds = {"face": timed(by_face, range(80))}
    A = mph.Projector(mph.Grid.centered(shape, spacing), views)
    A(density)
    begun = time.perf_counter()
    A(density)
    seconds["Projector"] = time.perf_counter() - begun
    try:
        from diffdrr.data import read
        from diffdrr.drr import DRR
        from torchio import ScalarImage
    except ImportError as error:
        print(f"DiffDRR is left out: {error}")
    else:
        subject = read(ScalarImage(tensor=torch.from_numpy(hu)[None], affine=mph.Grid.centered(shape, spacing).affine))
        theirs = DRR(subject, sdd=float(distances[0]), height=asked.pixels, delx=pitch, patch_size=64)

        def by_diffdrr(module: int) -> None:
            angles = torch.tensor([[alpha[module], beta[module], 0.0]], dtype=torch.float32)
            move = torch.tensor([[0.0, distances[module] / 2, 0.0]], dtype=torch.float32)
            with torch.no_grad():
                theirs(angles, move, parameterization="euler_angles", convention="ZXY")

        seconds["DiffDRR"] = timed(by_diffdrr, range(0, 80, 20))
    for name, all_of_them in seconds.items():
        print(f"{name}: {all_of_them:.3g} s for 80")
    if "DiffDRR" in seconds:
        work = f"80 DRRs, {asked.pixels}², of a CT of {' x '.join(map(str, shape))}"
        for name, words in (("face", "by the DiffDRR face"), ("Projector", "by `Projector`")):
            tell("radiographs", f"{work}, {words}", seconds[name], "DiffDRR 0.6.1", seconds["DiffDRR"])


if __name__ == "__main__":
    main()
