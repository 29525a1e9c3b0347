"""Time and error of the projector's backends, and of DiffDRR and nanodrr where they are installed, in one run.

    python benchmarks/projector.py [--voxels 128] [--pixels 128] [--repeats 3] [--skip numpy,DiffDRR]

All contenders integrate the same rays (one view of the 80-module scanner, from the pinhole to the virtual detector) through
the same dense random volume, in turn; the best of the repeats counts, after one call to warm up. The error is the largest
difference from the float64 reference, relative to the largest integral. nanodrr samples a trilinear volume, which is
another model: part of its difference is no error.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import mphdrr.core as mph

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
RAYS_AT_ONCE = 4096  # for peers that hold all samples of all rays at once

Contender = Callable[[], Any]


def main() -> None:
    arguments = parse_arguments()
    n = arguments.voxels
    grid = mph.Grid.centered((n, n, n), 256 / n)
    views = mph.read_system(WORKBOOK).views((arguments.pixels, arguments.pixels))[0]
    volume = np.random.default_rng(0).random(grid.shape, dtype=np.float32)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    forwards, adjoints = ours(grid, views, volume, sorted({1, cores}))
    forwards |= peers(grid, views, volume)
    for name in list(forwards):
        if any(name.startswith(skipped) for skipped in arguments.skip.split(",") if skipped):
            del forwards[name]
            adjoints.pop(name, None)

    print(f"{platform.machine()}, {cores} cores, Python {platform.python_version()}: one view of {arguments.pixels} x")
    print(f"{arguments.pixels} rays through {n} x {n} x {n} voxels; ratio: forward time / that of the fastest of ours")
    reference = mph.Projector(grid, views, backend="numpy")(volume).ravel()
    errors = {name: error(call(), reference) for name, call in forwards.items()}
    times = timed(forwards, arguments.repeats)
    for call in adjoints.values():
        call()
    adjoint_times = timed(adjoints, arguments.repeats)

    fastest = min(t for name, t in times.items() if name in adjoints)
    print(f"{'':24}{'forward ms':>12}{'adjoint ms':>12}{'ratio':>9}{'error':>10}")
    for name, t in sorted(times.items(), key=lambda item: item[1]):
        adjoint = f"{adjoint_times[name] * 1e3:12.1f}" if name in adjoints else f"{'':12}"
        print(f"{name:24}{t * 1e3:12.1f}{adjoint}{t / fastest:9.1f}{errors[name]:10.1e}")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Time and error of the projector's backends and of its peers.")
    parser.add_argument("--voxels", type=int, default=128, help="voxels along each side of a 256 mm cube")
    parser.add_argument("--pixels", type=int, default=128, help="pixels along each side of the image")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--skip", default="", help="contenders to leave out, comma-separated: numpy,torch,DiffDRR")
    return parser.parse_args()


def timed(calls: dict[str, Contender], repeats: int) -> dict[str, float]:
    """Best time in s of each call, the calls taking turns."""
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            best[name] = min(best[name], time.perf_counter() - start)
    return best


def error(image: Any, reference: np.ndarray) -> float:
    return float(np.abs(np.asarray(image, dtype=np.float64).ravel() - reference).max() / reference.max())


def ours(
    grid: mph.Grid, views: mph.Views, volume: np.ndarray, threads: list[int]
) -> tuple[dict[str, Contender], dict[str, Contender]]:
    forwards: dict[str, Contender] = {}
    adjoints: dict[str, Contender] = {}
    for backend in ("numba", "torch", "numpy"):
        if backend != "numpy" and importlib.util.find_spec(backend) is None:
            print(f"{backend} is not installed")
            continue
        for n in threads if backend != "torch" else threads[-1:]:
            name = f"{backend}, {n} thread{'s' if n > 1 else ''}"
            A = mph.Projector(grid, views, backend=backend, threads=n)
            images = np.ones((1, *views.shape), np.float32)
            forwards[name] = lambda A=A: A(volume)
            adjoints[name] = lambda A=A, images=images: A.T(images)
    return forwards, adjoints


def peers(grid: mph.Grid, views: mph.Views, volume: np.ndarray) -> dict[str, Contender]:
    found: dict[str, Contender] = {}
    for name, make in (("DiffDRR Siddon", diffdrr), ("nanodrr, 500 samples", nanodrr)):
        try:
            found[name] = make(grid, views, volume)
        except ImportError as missing:
            print(f"{name}: not measured ({missing})")
    return found


def diffdrr(grid: mph.Grid, views: mph.Views, volume: np.ndarray) -> Contender:
    import torch
    from diffdrr.renderers import Siddon

    siddon = Siddon(voxel_shift=0.5)
    voxels = torch.from_numpy(volume)
    sources, targets = (
        points @ grid.index_from_world[:3, :3].T + grid.index_from_world[:3, 3] for points in views.rays(0)
    )
    lengths = torch.from_numpy(np.linalg.norm(np.subtract(*views.rays(0)), axis=1)).float()
    source, target = (torch.from_numpy(points).float()[None] for points in (sources, targets))

    def render() -> Any:
        with torch.no_grad():
            return torch.cat(
                [
                    siddon(voxels, s, t, length[None, None])[0, 0]
                    for s, t, length in zip(
                        source.split(RAYS_AT_ONCE, 1),
                        target.split(RAYS_AT_ONCE, 1),
                        lengths.split(RAYS_AT_ONCE),
                        strict=True,
                    )
                ]
            )

    return render


def nanodrr(grid: mph.Grid, views: mph.Views, volume: np.ndarray, samples: int = 500) -> Contender:
    import torch
    from nanodrr.drr.backends import render_torch

    # grid_sample wants (D, H, W) voxels and, as points, (x, y, z) in -1..1 from face to face of (W, H, D).
    normalized = np.diag([*(2 / np.array(grid.shape)), 1.0])
    normalized[:3, 3] = 1 / np.array(grid.shape) - 1
    subject = SimpleNamespace(
        image=torch.from_numpy(np.ascontiguousarray(volume.T))[None, None],
        world_to_grid=torch.from_numpy(normalized @ grid.index_from_world).float()[None],
        n_classes=1,
    )
    source, target = (torch.from_numpy(np.array(points)).float()[None] for points in views.rays(0))
    steps = (target - source).norm(dim=-1) / samples
    identity = torch.eye(4)[None]

    def render() -> Any:
        with torch.no_grad():
            return torch.cat(
                [
                    render_torch(subject, identity, s, t, step, samples, 1, step.shape[1])[0, 0, 0]
                    for s, t, step in zip(
                        source.split(RAYS_AT_ONCE, 1),
                        target.split(RAYS_AT_ONCE, 1),
                        steps.split(RAYS_AT_ONCE, 1),
                        strict=True,
                    )
                ]
            )

    return render


if __name__ == "__main__":
    main()
