"""Pinhole images by the depth-dependent response in torch, part of its graph. Needs torch."""

import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..arrays import is_double, is_tensor, to_numpy
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics.optics import Optics
from ..pinhole_response.oblique_kernels import DirectionalEffects
from ..pinhole_response.pinhole_operator import PinholeOperator, depth_backend
from ..pinhole_response.transmittance import ArrayOnGrid
from ..rays import autograd
from ..rays.lattices import require_no_negative
from ..rays.parallel import thread_count
from ..volumes.volume import Volume


class Holes(NamedTuple):
    """Numbers of cameras (...), as tensors."""

    length: Tensor
    diameter: Tensor
    side: Tensor | None  # the crystal's, if nothing is counted beyond
    thickness: Tensor
    pitch: Tensor  # (..., 2): u, v
    offset: Tensor  # (..., 2)


def depth_images(
    volume: Volume | Tensor,
    grid: Grid,
    poses: tuple[Tensor, Tensor],
    holes: Holes,
    shape: tuple[int, int],
    time: Tensor,
    mu: Volume | Tensor | None,
    mu_grid: Grid | None,
    optics: Optics,
) -> Tensor:
    """`emission_images` by hole "depth", of numbers that it has checked; `optics` has those of the cameras (...)."""
    positions, rotations = poses
    cameras = positions.shape[:-1]
    by_diameter = () if optics.edge == "path" else ("aperture_mu", "opening_angle")
    for name, number in {"crystal_thickness": holes.thickness, "crystal_side": holes.side, **optics.numbers}.items():
        if name not in ("photons_per_decay", *by_diameter) and getattr(number, "requires_grad", False):
            what = f"hole 'depth' has no derivatives by {name}"
            raise InputError(f"emission images: {what}: take hole 'rays', or detach it")
    factors = time * optics.photons_per_decay
    plain = optics.with_numbers({"photons_per_decay": 1.0})
    effective = _one_kernel(plain).effective_diameter(holes.diameter)
    array: Any = volume.array if isinstance(volume, Volume) else volume
    attenuation: Any = mu.array if isinstance(mu, Volume) else mu
    mu_grid = mu.grid if isinstance(mu, Volume) else mu_grid or grid

    def run(needs: Any) -> Any:
        kind = np.float64 if is_double(array) or is_double(positions) else np.float32
        given, on_mu = to_numpy(array, kind), None
        if attenuation is not None:
            on_mu = ArrayOnGrid(require_no_negative(to_numpy(attenuation, kind)), mu_grid)
        model = _whole_holes(grid, poses, holes, effective, shape, plain, on_mu)
        functions = depth_backend()
        threads = thread_count(None)
        images = np.stack(list(model.images(given, functions, threads))).reshape(*cameras, *shape)

        def gradients(gradient: Tensor, needs: Any) -> list[Tensor | None]:
            weights = to_numpy(gradient, kind).reshape(-1, *shape)
            found: list[Any] = [None] * 8
            if needs[0]:
                found[0] = model.backproject(weights, functions, threads, lambda done: None)
            if needs[1] and on_mu is not None:
                found[1] = model.mu_gradient(given, weights, functions, threads, on_mu)
            if any(needs[2:]):
                found[2:] = _by_cameras(model, given, weights, functions, threads)
            wanted = (array, attenuation, positions, rotations, holes.length, effective, holes.pitch, holes.offset)
            return [
                torch.as_tensor(own).reshape(like.shape).to(like) if need else None
                for own, like, need in zip(found, wanted, needs, strict=True)
            ]

        return torch.from_numpy(images).to(positions), gradients

    inputs = positions, rotations, holes.length, effective, holes.pitch, holes.offset
    return autograd.step(run, array, attenuation, *inputs) * factors[..., None, None]


def _one_kernel(optics: Optics) -> Optics:
    """Without what is in kernels that depend on the direction."""
    within_cone = optics.within_cone or optics.edge == "path"
    changed = copy.copy(optics)
    changed.__dict__.update(edge="paix", depth_layers=1, plate_thickness=None, within_cone=within_cone)
    return changed


def _whole_holes(
    grid: Grid,
    poses: tuple[Tensor, Tensor],
    holes: Holes,
    effective: Tensor,
    shape: tuple[int, int],
    optics: Optics,
    mu: ArrayOnGrid | None,
) -> PinholeOperator:
    """The model of cameras that stand still."""
    n = poses[0][..., 0].numel()

    def each(number: Tensor, *last: int) -> Any:
        return number.numpy(force=True).astype(np.float64).reshape(n, *last)

    views = camera_views(*poses, holes.length, holes.pitch, holes.offset, shape)
    sides = np.full(n, np.inf) if holes.side is None else each(holes.side)
    thickness, hole = each(holes.thickness), each(holes.diameter)
    numbers = {name: each(x) if is_tensor(x) else x for name, x in optics.numbers.items()}
    optics = replace(optics.with_numbers(numbers), within_crystal=False, within_walls=False)
    passages = [
        DirectionalEffects.from_optics(optics.of_modules(m, n), float(hole[m]), float(thickness[m])) for m in range(n)
    ]
    lengths, plain = each(holes.length) + [each.mean_depth for each in passages], _one_kernel(optics)

    def ray_weight(m: int, *, u: Any, v: Any) -> Any:
        own = plain.of_modules(m, n)
        (opening,) = own.openings(hole[m])
        return own.pixel_weights((u, v), (1.0, 1.0), lengths[m], np.inf, thickness[m], opening)

    slants = None if optics.edge == "paix" and optics.depth_layers == 1 else passages
    of_modules = each(poses[1], 3, 3).transpose(0, 2, 1), lengths, each(effective), sides, ray_weight
    return PinholeOperator(views, grid, *of_modules, mu, True, slants)


def camera_views(
    positions: Tensor, rotations: Tensor, distance: Tensor, pitch: Tensor, offset: Tensor, shape: tuple[int, int]
) -> Views:
    """Cameras (...) as `Views`, one after the other."""
    numbers = positions, rotations, distance, pitch, offset
    position, rotation, along, size, middle = (
        x.numpy(force=True).astype(np.float64).reshape(-1, *x.shape[positions.ndim - 1 :]) for x in numbers
    )
    u, v, k = np.moveaxis(rotation, 2, 0)
    centers = position + along[:, None] * k + middle[:, :1] * u + middle[:, 1:] * v
    return Views(position, centers, size[:, :1] * u, size[:, 1:] * v, shape)


def _by_cameras(model: PinholeOperator, volume: Any, weights: Any, functions: Any, threads: int) -> list[Any]:
    """Derivatives by positions, rotations, lengths, effective diameters, pitches and offsets."""
    centers, frames, by = model.gradient(volume[None], weights[None], functions, threads)
    pitch, first = (by[name][:, ::-1].copy() for name in ("pitch", "first"))
    return [centers, frames.transpose(0, 2, 1), by["length"], by["diameter"], pitch, first]
