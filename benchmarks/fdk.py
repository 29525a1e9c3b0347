"""FDK beside RTK's: the same views, images and voxels, two calls each in turn, the faster one counts.

    python benchmarks/fdk.py [--voxels 128] [--views 180] [--threads 2]

RTK (the wheel itk-rtk) is left out where it is not installed. Its time is that of its filters alone: weights, ramp and
backprojection, without our reading or copying.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from beside import tell

RADIUS, DISTANCE, MU = 500.0, 1000.0, 0.02


def circle(n: int, pixels: int, pitch: float) -> Any:
    """Return views on a circle around z, at RTK's angles, which begin at 0."""
    import mphdrr.core as mph

    angle = 2 * np.pi * np.arange(n) / n
    towards = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    return mph.Views(RADIUS * towards, (RADIUS - DISTANCE) * towards, pitch * along, pitch * up, (pixels, pixels))


def ball_images(views: Any, radius: float) -> np.ndarray:
    """Return exact line integrals of a ball at the isocentre."""
    images = []
    for m in range(len(views)):
        starts, ends = views.rays(m)
        along = (ends - starts) / np.linalg.norm(ends - starts, axis=1)[:, None]
        miss = (starts**2).sum(axis=1) - (starts * along).sum(axis=1) ** 2
        images.append(2 * MU * np.sqrt(np.clip(radius**2 - miss, 0, None)))
    return np.reshape(images, (len(views), *views.shape)).astype(np.float32)


def rtk(images: np.ndarray, n: int, voxels: int, size: float, pitch: float) -> Callable[[], np.ndarray]:
    """Return a call of RTK's FDK. Its volumes have other axes, [y or x, z, x or y], which does not matter for a ball."""
    import itk
    from itk import RTK

    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    for m in range(n):
        geometry.AddProjection(RADIUS, DISTANCE, 360.0 * m / n)
    kind = itk.Image[itk.F, 3]
    pixels = images.shape[1]
    stack = itk.image_from_array(images)
    stack.SetOrigin([-(pixels - 1) / 2 * pitch] * 2 + [0.0])
    stack.SetSpacing([pitch, pitch, 1.0])

    def call() -> np.ndarray:
        empty = RTK.ConstantImageSource[kind].New(
            Origin=[-(voxels - 1) / 2 * size] * 3, Spacing=[size] * 3, Size=[voxels] * 3, Constant=0.0
        )
        fdk = RTK.FDKConeBeamReconstructionFilter[kind].New()
        fdk.SetInput(0, empty.GetOutput())
        fdk.SetInput(1, stack)
        fdk.SetGeometry(geometry)
        fdk.Update()
        return np.array(itk.array_view_from_image(fdk.GetOutput()))

    return call


def ours(images: np.ndarray, views: Any, voxels: int, size: float) -> Callable[[], np.ndarray]:
    """Return a call of `mph.fdk`."""
    import mphdrr.core as mph

    grid = mph.Grid.centered(voxels, size)
    return lambda: mph.fdk(images, views, grid).array


def main() -> None:
    """Print times, their ratio and each volume's central value."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("voxels", 128), ("views", 180), ("threads", 2), ("turns", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    chosen = parser.parse_args()
    os.environ["ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS"] = str(chosen.threads)
    from mphdrr.core.rays.parallel import set_usual_threads

    set_usual_threads(chosen.threads)
    pitch, size = 400.0 / chosen.voxels, 180.0 / chosen.voxels
    views = circle(chosen.views, chosen.voxels, pitch)
    images = ball_images(views, 60.0)
    calls = {"mphDRR": ours(images, views, chosen.voxels, size)}
    try:
        calls["RTK"] = rtk(images, chosen.views, chosen.voxels, size, pitch)
    except ImportError as error:
        print(f"RTK is left out: {error}")
    best = dict.fromkeys(calls, np.inf)
    for turn in range(chosen.turns):
        for name, call in calls.items():
            begun = time.perf_counter()
            volume = call()
            best[name] = min(best[name], time.perf_counter() - begun)
            if turn == 0:
                half, few = chosen.voxels // 2, max(1, chosen.voxels // 32)
                middle = volume[(slice(half - few, half + few),) * 3].mean() / MU
                print(f"{name}: {middle:.4f} of the truth in the middle")
    for name, seconds in best.items():
        print(f"{name}: {seconds:.3g} s, {seconds / best['mphDRR']:.3g} x mphDRR's")
    if "RTK" in best:
        work = f"FDK, {chosen.views} views of {chosen.voxels}², {chosen.voxels}³"
        tell("X rays", work, best["mphDRR"], "RTK", best["RTK"])


if __name__ == "__main__":
    main()
