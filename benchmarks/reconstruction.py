"""Seconds of an iteration of MLEM and OSEM: ours, and other packages' own loops over the same operators, in one run.

    make bench-reconstruction VENV=.venvpeers
    python benchmarks/reconstruction.py [--voxels 64] [--pixels 64] [--subsets 16] [--iterations 4] [--rounds 2]

80 modules, Tc-99m, seven rays a pixel, a Derenzo phantom, counts with noise and a background. All contenders take turns. An
iteration's time is the difference between many iterations and one, the least of the rounds: what is prepared once does not
count. Packages that are not there are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from beside import tell

import mphdrr.core as mph

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"

Contender = Callable[[int, int], Any]
"""The volume after so many iterations with so many subsets."""


def main() -> None:
    """Print the table of times and differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workbook", default=WORKBOOK)
    for name, default in (("voxels", 64), ("pixels", 64), ("subsets", 16), ("iterations", 4), ("rounds", 2)):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()
    warnings.simplefilter("ignore", mph.InputWarning)
    A, counts = problem(asked.workbook, asked.voxels, asked.pixels)
    contenders = {"mphDRR": ours(A, counts), **pytomography_loops(A, counts), **deepinv_loops(A, counts)}
    x, y = A.T(counts), counts
    both = min(seconds(lambda: (A(x), A.T(y))) for _ in range(asked.rounds + 1))
    print(f"{A!r}: forward and adjoint {both:.3f} s\n")
    print(
        "| algorithm | loop of | s an iteration | to mphDRR's | to forward + adjoint | differs from mphDRR's volume by |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for subsets in (1, asked.subsets):
        volumes = {name: np.asarray(run(2, subsets)) for name, run in contenders.items()}
        best = dict.fromkeys(contenders, np.inf)
        for _ in range(asked.rounds):
            for name, run in contenders.items():
                many, one = (seconds(run, n, subsets) for n in (1 + asked.iterations, 1))
                best[name] = min(best[name], (many - one) / asked.iterations)
        own, reference = best["mphDRR"], volumes["mphDRR"]
        for name, each in best.items():
            differs = np.abs(volumes[name] - reference).max() / reference.max()
            method = "MLEM" if subsets == 1 else f"OSEM, {subsets} subsets"
            row = f"| {method} | {name} | {each:.3f} | {each / own:.2f} | {each / both:.2f} | {differs:.1e} |"
            print(row, flush=True)
            if name != "mphDRR":
                work = f"{method}, an iteration, {asked.voxels}³, 80 views of {asked.pixels}²"
                tell("reconstruction", work, own, name, each, "its loop over our operators")


def problem(workbook: str | Path, voxels: int, pixels: int) -> tuple[mph.Projector, np.ndarray]:
    """Return a projector, and counts simulated on a grid twice as fine with more points of the hole."""
    system = mph.read_system(workbook)
    views = system.views((pixels, pixels), "real")
    physics: dict[str, Any] = {"time": 600.0, "isotope": "Tc-99m", "aperture_mu": "tungsten", "crystal_mu": "NaI"}
    grid, fine = (mph.Grid.centered(n, 96.0 / n) for n in (voxels, 2 * voxels))
    truth = mph.DerenzoPhantom(radius=40, rod_diameters=(8, 6, 5, 4, 3, 2), height=40).voxelize(fine)
    model = mph.Emission(system, **physics, aperture_points=13, pixel_points=1)
    counts = mph.sample_counts(mph.Projector(fine, views, model)(truth) + 0.05, 1).astype(np.float32)
    model = mph.Emission(system, **physics, aperture_points=7, pixel_points=1, background=0.05)
    return mph.Projector(grid, views, model), counts


def seconds(call: Callable[..., Any], *arguments: Any) -> float:
    """Return the wall time of a call."""
    started = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - started


def ours(A: mph.Projector, counts: np.ndarray) -> Contender:
    """Return mphDRR's OSEM as a contender."""
    return lambda iterations, subsets: mph.osem(A, counts, iterations, subsets).volume.array


def pytomography_loops(A: mph.Projector, counts: np.ndarray) -> dict[str, Contender]:
    """Return PyTomography's OSEM as a contender; none where it is not installed."""
    if importlib.util.find_spec("pytomography") is None:
        return {}
    matrix = mph.pytomography_matrix(A)
    import torch
    from pytomography.algorithms import OSEM
    from pytomography.likelihoods import PoissonLogLikelihood

    likelihood = PoissonLogLikelihood(matrix, torch.tensor(counts), torch.tensor(A.background))
    return {"PyTomography": lambda iterations, subsets: OSEM(likelihood)(iterations, subsets)}


def deepinv_loops(A: mph.Projector, counts: np.ndarray) -> dict[str, Contender]:
    """Return deepinv's MLEM and OSEM as a contender; none where it is not installed."""
    if importlib.util.find_spec("deepinv") is None:
        return {}
    import torch

    try:
        import torchvision  # noqa: F401
    except RuntimeError:  # it is built for another torch than a CPU one, and asks for these operators of its own
        torch.library_of_torchvision = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            torch.library_of_torchvision.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        sys.modules.pop("torchvision", None)
    import deepinv

    physics, y = mph.deepinv_physics(A), torch.tensor(counts)[None, None]
    split: dict[int, Any] = {}

    def run(iterations: int, subsets: int) -> Any:
        with torch.no_grad():
            if subsets == 1:
                return deepinv.optim.MLEM(max_iter=iterations)(y, physics)[0, 0]
            if subsets not in split:
                split[subsets] = physics.split_measurements(y, subsets), physics.split_physics(subsets)
            return deepinv.optim.OSEM(max_iter=iterations, num_subsets=subsets)(*split[subsets])[0, 0]

    return {"deepinv": run}


if __name__ == "__main__":
    main()
