"""The "cuda" backend beside DiffDRR, nanodrr and ASTRA, on an NVIDIA GPU, in one run (docs/gpu.md).

    pip install '.[cuda,torch]' diffdrr nanodrr astra-toolbox
    python benchmarks/gpu.py [--voxels 256] [--pixels 256] [--views 80] [--repeats 5]

All integrate the same rays, from the pinholes of the 80-module scanner to its virtual detectors, through the same dense
random volume, which is on the GPU as their results are. They take turns; the best of the repeats counts, after one call
to warm up. DiffDRR and nanodrr are given one view at a time. The error is the largest difference from the float64
reference in the first view, relative to the largest integral; nanodrr samples a trilinear volume and ASTRA interpolates
(Joseph): part of their difference is no error. Without a GPU it says so and ends; --device cpu runs what can run, to try
the script.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

import mphdrr.core as mph
from mphdrr.core.rays import backends

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
SIDE = 256.0  # mm, of the cube of voxels
SAMPLES = 500  # of nanodrr, along a ray

Call = Callable[[], Any]


@dataclass(frozen=True)
class Case:
    """Views of the scanner through a cube of voxels; `volume` and `images` are tensors on `device`."""

    system: mph.PinholeSystem
    views: mph.Views
    grid: mph.Grid
    volume: Any
    images: Any
    device: str

    def __getitem__(self, views: slice) -> Case:
        """Return the case with some of the views."""
        return replace(self, system=self.system[views], views=self.views[views], images=self.images[views])


@dataclass(frozen=True)
class Contender:
    """A program to be timed: `forward` returns all images (M, n_v, n_u); its name, and the views per call."""

    name: str
    n_views: int
    forward: Call
    adjoint: Call | None = None
    same_integrals: bool = True


def main() -> None:
    """Print a table of times and errors, or the reason why nothing can be measured."""
    arguments = parse_arguments()
    try:
        import torch
    except ImportError:
        print("benchmarks/gpu.py: torch is needed here: pip install '.[cuda,torch]'")
        return
    if arguments.device == "cpu":
        os.environ["MPHDRR_CUDA_DEVICE"] = "cpu"
    elif not torch.cuda.is_available():
        print("benchmarks/gpu.py: torch finds no NVIDIA GPU on this machine; nothing is measured")
        return
    try:
        backends.choose("cuda")
    except mph.InputError as error:
        print(f"benchmarks/gpu.py: {error}; nothing is measured")
        return
    case = make_case(arguments.voxels, arguments.pixels, arguments.views, arguments.device)
    name = torch.cuda.get_device_name() if arguments.device == "cuda" else "the CPU, instead of a GPU"
    n_views, n_v, n_u = case.images.shape
    print(f"{name}: {n_views} views of {n_v} x {n_u} rays through {arguments.voxels}^3 voxels; ms a view")
    print(f"{'':42}{'forward':>10}{'adjoint':>10}{'error':>10}")
    for contender, forward, adjoint, error in measure(case, arguments.repeats):
        numbers = f"{forward:10.3f}" + (f"{adjoint:10.3f}" if adjoint is not None else f"{'':10}")
        print(f"{contender.name:42}{numbers}" + (f"{error:10.1e}" if error is not None else ""))


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description="The CUDA backend beside its peers.")
    parser.add_argument("--voxels", type=int, default=256, help="along each side of a 256 mm cube")
    parser.add_argument("--pixels", type=int, default=256, help="along each side of an image")
    parser.add_argument("--views", type=int, default=80, help="at most 80")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    return parser.parse_args()


def make_case(voxels: int, pixels: int, n_views: int, device: str) -> Case:
    """Make views of `n_views` modules, and random volume and images on the device."""
    import torch

    system = mph.read_system(WORKBOOK)
    system = system[np.arange(n_views) * len(system) // n_views]
    grid = mph.Grid.centered((voxels,) * 3, SIDE / voxels)
    generator = np.random.default_rng(0)
    volume, images = (
        torch.from_numpy(generator.random(shape, dtype=np.float32)).to(device)
        for shape in (grid.shape, (n_views, pixels, pixels))
    )
    return Case(system, system.views((pixels, pixels)), grid, volume, images, device)


def measure(case: Case, repeats: int = 5) -> list[tuple[Contender, float, float | None, float | None]]:
    """Return every contender with forward and adjoint, ms a view, and the error of its first image."""
    found = list(contenders(case))
    reference = mph.Projector(case.grid, case.views[:1], backend="numpy")(case.volume.cpu().numpy())[0]
    errors = [error(c.forward(), reference) if c.same_integrals else None for c in found]
    forwards = timed([c.forward for c in found], repeats, case.device)
    adjoints = timed([c.adjoint or (lambda: None) for c in found], repeats, case.device)
    return [
        (c, 1e3 * forward / c.n_views, 1e3 * adjoint / c.n_views if c.adjoint else None, e)
        for c, forward, adjoint, e in zip(found, forwards, adjoints, errors, strict=True)
    ]


def error(images: Any, reference: np.ndarray) -> float:
    """Return the largest difference of the first image from the reference, relative to the largest integral."""
    return float(np.abs(images[0].detach().cpu().numpy() - reference).max() / reference.max())


def timed(calls: list[Call], repeats: int, device: str) -> list[float]:
    """Return the best time of each call, s; the calls take turns."""
    import torch

    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    best = [float("inf")] * len(calls)
    for repeat in range(repeats + 1):
        for i, call in enumerate(calls):
            wait()
            start = time.perf_counter()
            call()
            wait()
            if repeat > 0:  # the first is to warm up
                best[i] = min(best[i], time.perf_counter() - start)
    return best


def contenders(case: Case) -> Iterator[Contender]:
    """Yield all contenders; print the reason where a peer cannot be measured."""
    yield from ours(case)
    for make in (diffdrr, nanodrr, astra):
        try:
            yield make(case)
        except (ImportError, OSError) as missing:
            print(f"{make.__name__}: not measured ({str(missing).splitlines()[0]})")


def ours(case: Case) -> Iterator[Contender]:
    """Yield the contenders of mphDRR."""
    import torch

    n, one = len(case.views), case[:1]
    A, B = (mph.Projector(c.grid, c.views, backend="cuda") for c in (case, one))
    yield Contender("cuda", n, lambda: A(case.volume), lambda: A.T(case.images))
    yield Contender("cuda, one view a call", 1, lambda: B(case.volume), lambda: B.T(one.images))
    host, host_images = case.volume.cpu().numpy(), case.images.cpu().numpy()
    yield Contender(
        "cuda, arrays on the CPU", n, lambda: torch.from_numpy(A(host)), lambda: torch.from_numpy(A.T(host_images))
    )
    mu = mph.Volume(np.full(case.grid.shape, 0.015, np.float32), case.grid, "mu")
    model = mph.Emission(case.system, mu=mu, hole="point", pixel_points=1, tolerance=1e9)
    C = mph.Projector(case.grid, case.views, model, backend="cuda")
    yield Contender("cuda, emission with mu", n, lambda: C(case.volume), lambda: C.T(case.images), False)

    sources, targets = (torch.from_numpy(np.array(points)) for points in case.views.rays(0))
    source = sources[:1].clone().requires_grad_()

    def with_gradients() -> Any:
        mph.trace_rays(case.volume, source, targets, "cuda", case.grid).sum().backward()

    yield Contender("cuda, one view with its pose's gradient", 1, with_gradients, None, False)
    D = mph.Projector(case.grid, case[:1].views, backend="torch")
    yield Contender("torch, one view a call", 1, lambda: D(case.volume), lambda: D.T(one.images))


def rays(case: Case) -> list[tuple[Any, Any]]:
    """Return the ends of every view's rays, (N, 3) in world mm."""
    import torch

    views = [case.views.rays(m) for m in range(len(case.views))]
    return [tuple(torch.from_numpy(np.array(points)).to(case.device) for points in ends) for ends in views]


def by_autograd(case: Case, name: str, volume: Any, render: Callable[[Any, Any], Any], limit: int) -> Contender:
    """Return the contender of a renderer in torch: `render` makes the image of one view, `limit` is the number of views."""
    import torch

    views = rays(case[:limit])

    def forward() -> Any:
        with torch.no_grad():
            return torch.stack([render(*ends).reshape(case.views.shape) for ends in views])

    def adjoint() -> None:
        volume.grad = None
        for ends, image in zip(views, case.images, strict=False):
            (render(*ends) * image.reshape(-1)).sum().backward()

    volume.requires_grad_()
    return Contender(name, len(views), forward, adjoint)


def diffdrr(case: Case) -> Contender:
    """Return the contender of DiffDRR."""
    import torch
    from diffdrr.renderers import Siddon

    siddon, volume = Siddon(voxel_shift=0.5), case.volume.clone()
    to_index = torch.from_numpy(case.grid.index_from_world.copy()).to(case.device)

    def render(sources: Any, targets: Any) -> Any:
        lengths = (targets - sources).norm(dim=-1).float()
        ends = [(x @ to_index[:3, :3].T + to_index[:3, 3]).float()[None] for x in (sources, targets)]
        return siddon(volume, *ends, lengths[None, None])[0, 0]

    return by_autograd(case, "DiffDRR, Siddon", volume, render, 2)


def nanodrr(case: Case) -> Contender:
    """Return the contender of nanodrr."""
    import torch
    from nanodrr.drr.backends import render_fused, render_torch

    volume = case.volume.permute(2, 1, 0).contiguous()[None, None]
    to_index = case.grid.index_from_world
    # grid_sample wants, as points, (x, y, z) in -1..1 from face to face.
    normalized = np.diag([*(2 / np.array(case.grid.shape)), 1.0])
    normalized[:3, 3] = 1 / np.array(case.grid.shape) - 1
    affines = {"world_to_voxel": to_index, "world_to_grid": normalized @ to_index}
    affines = {name: torch.from_numpy(affine).float()[None].to(case.device) for name, affine in affines.items()}
    subject = SimpleNamespace(image=volume, n_classes=1, **affines)
    eye = torch.eye(4, device=case.device)[None]
    fused = case.device == "cuda"

    def render(sources: Any, targets: Any) -> Any:
        ends = sources.float()[None], targets.float()[None]
        step = (ends[1] - ends[0]).norm(dim=-1) / SAMPLES
        rest = subject, eye, *ends, step, SAMPLES, *case.views.shape
        return (render_fused("triton", *rest) if fused else render_torch(*rest)).reshape(-1)

    name = f"nanodrr, {SAMPLES} samples, {'Triton' if fused else 'torch'}"
    return by_autograd(case, name, volume, render, len(case.views))


def astra(case: Case) -> Contender:
    """Return the contender of ASTRA."""
    import astra
    import torch

    if case.device != "cuda":
        raise ImportError("its cone beams need a GPU")
    nx, ny, nz = case.grid.shape
    half = SIDE / 2
    volume_geometry = astra.create_vol_geom(ny, nx, nz, -half, half, -half, half, -half, half)
    views = case.views
    vectors = np.hstack([views.sources, views.detector_centers, views.u_steps, views.v_steps])
    geometry = astra.create_proj_geom("cone_vec", *views.shape, vectors)
    volume = case.volume.permute(2, 1, 0).contiguous()
    images = case.images.transpose(0, 1).contiguous()  # rows, views, columns

    def algorithm(name: str, of_volume: str, voxels: Any, pixels: Any) -> Call:
        settings = astra.astra_dict(name)
        settings[of_volume] = astra.data3d.link("-vol", volume_geometry, voxels)
        settings["ProjectionDataId"] = astra.data3d.link("-sino", geometry, pixels)
        identifier = astra.algorithm.create(settings)
        return lambda: astra.algorithm.run(identifier)

    projected, spread = torch.empty_like(images), torch.empty_like(volume)
    project = algorithm("FP3D_CUDA", "VolumeDataId", volume, projected)
    back = algorithm("BP3D_CUDA", "ReconstructionDataId", spread, images)

    def forward() -> Any:
        project()
        return projected.transpose(0, 1)

    return Contender("ASTRA, FP3D_CUDA and BP3D_CUDA", len(views), forward, back)


if __name__ == "__main__":
    main()
