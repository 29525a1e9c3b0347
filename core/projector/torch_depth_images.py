"""Counts of pinhole cameras by the depth-dependent response, as a step of torch's graph. Needs torch."""

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
from ..pinhole_response.directional_effects import DirectionalEffects
from ..pinhole_response.pinhole_operator import PinholeOperator, depth_backend
from ..pinhole_response.transmittance import ArrayOnGrid
from ..rays import autograd
from ..rays.lattices import require_no_negative
from ..rays.parallel import thread_count
from ..volumes.volume import Volume


class CameraTensors(NamedTuple):
    """Numbers of pinhole cameras, tensors with the cameras' axes (...)."""

    positions: Tensor
    """(..., 3), positions of the pinholes, world mm."""
    rotations: Tensor
    """(..., 3, 3), rotations from camera to world."""
    length: Tensor
    """(...), collimator lengths, mm."""
    diameter: Tensor
    """(...), diameters of the holes, mm."""
    crystal_side: Tensor | None
    """(...), sides of the crystals, mm; None if their ends are not taken into account."""
    thickness: Tensor
    """(...), thicknesses of the crystals, mm."""
    pitch: Tensor
    """(..., 2), pixel sizes along u and v, mm."""
    offset: Tensor
    """(..., 2), positions of the images' middles along u and v, mm."""


def depth_images(
    volume: Volume | Tensor,
    grid: Grid,
    cameras: CameraTensors,
    shape: tuple[int, int],
    time: Tensor,
    mu: Volume | Tensor | None,
    mu_grid: Grid | None,
    optics: Optics,
) -> Tensor:
    """Return `emission_images` (..., n_v, n_u) by hole "depth", for arguments that it has checked.

    The numbers of `optics` are those of the cameras (...).
    """
    positions, batch = cameras.positions, cameras.positions.shape[:-1]
    diameter_settings = () if optics.edge == "path" else ("aperture_mu", "opening_angle")
    constants = {"crystal_thickness": cameras.thickness, "crystal_side": cameras.crystal_side, **optics.numbers}
    for name, number in constants.items():
        if name not in ("photons_per_decay", *diameter_settings) and getattr(number, "requires_grad", False):
            reason = f"hole 'depth' has no derivatives by {name}"
            raise InputError(f"emission images: {reason}: take hole 'rays', or detach it")
    factors = time * optics.photons_per_decay
    unit_optics = optics.with_numbers({"photons_per_decay": 1.0})
    effective_diameter = _without_directional_effects(unit_optics).effective_diameter(cameras.diameter)
    array: Any = volume.array if isinstance(volume, Volume) else volume
    attenuation: Any = mu.array if isinstance(mu, Volume) else mu
    mu_grid = mu.grid if isinstance(mu, Volume) else mu_grid or grid

    def images_and_gradient(needs: Any) -> Any:
        """Return the images, and the function that turns their gradient into those of the inputs."""
        dtype = np.float64 if is_double(array) or is_double(positions) else np.float32
        voxels, mu_on_grid = to_numpy(array, dtype), None
        if attenuation is not None:
            mu_on_grid = ArrayOnGrid(require_no_negative(to_numpy(attenuation, dtype)), mu_grid)
        views = camera_views(*cameras[:3], cameras.pitch, cameras.offset, shape)
        A = _pinhole_operator(views, grid, cameras, effective_diameter, unit_optics, mu_on_grid)
        backend, threads = depth_backend(), thread_count(None)
        images = np.stack(list(A.images(voxels, backend, threads, None))).reshape(*batch, *shape)

        def input_gradients(gradient: Tensor, needs: Any) -> list[Tensor | None]:
            """Return the gradients by the inputs that need one, None for the others."""
            weights = to_numpy(gradient, dtype).reshape(-1, *shape)
            arrays: list[Any] = [None] * 8
            if needs[0]:
                arrays[0] = A.backproject(weights, backend, threads, lambda n_done: None)
            if needs[1] and mu_on_grid is not None:
                arrays[1] = A.mu_gradient(voxels, weights, backend, threads, mu_on_grid)
            if any(needs[2:]):
                arrays[2:] = _camera_gradients(A, voxels, weights, backend, threads)
            return [
                torch.as_tensor(values).reshape(tensor.shape).to(tensor) if need else None
                for values, tensor, need in zip(arrays, (array, attenuation, *inputs), needs, strict=True)
            ]

        return torch.from_numpy(images).to(positions), input_gradients

    inputs = *cameras[:3], effective_diameter, cameras.pitch, cameras.offset
    return autograd.step(images_and_gradient, array, attenuation, *inputs) * factors[..., None, None]


def _without_directional_effects(optics: Optics) -> Optics:
    """Return the optics without path through the edge and depths in the crystal, which kernels have, but with its cone."""
    within_cone = optics.within_cone or optics.edge == "path"
    changed = copy.copy(optics)
    changed.__dict__.update(edge="paix", depth_layers=1, plate_thickness=None, within_cone=within_cone)
    return changed


def _pinhole_operator(
    views: Views, grid: Grid, cameras: CameraTensors, effective_diameter: Tensor, optics: Optics, mu: ArrayOnGrid | None
) -> PinholeOperator:
    """Return the pinhole operator of the cameras as they are now, without gradients; `views` are the cameras'."""
    n = len(views)

    def to_array(number: Tensor, *last: int) -> Any:
        """Return the cameras' numbers as an array (M, *last) of float64."""
        return number.numpy(force=True).astype(np.float64).reshape(n, *last)

    sides = np.full(n, np.inf) if cameras.crystal_side is None else to_array(cameras.crystal_side)
    thickness, diameter = to_array(cameras.thickness), to_array(cameras.diameter)
    numbers = {name: to_array(x) if is_tensor(x) else x for name, x in optics.numbers.items()}
    optics = replace(optics.with_numbers(numbers), within_crystal=False, within_walls=False)
    sizes = zip(diameter.tolist(), thickness.tolist(), strict=True)
    effects = [DirectionalEffects.from_optics(optics.of_modules(m, n), *size) for m, size in enumerate(sizes)]
    plain = _without_directional_effects(optics)
    lengths = to_array(cameras.length) + [camera.mean_depth for camera in effects]

    def ray_weight(m: int, *, u: Any, v: Any) -> Any:
        """Return the expected counts per mm^2 of crystal of the rays of camera m to (v, u), mm."""
        camera = plain.of_modules(m, n)
        (opening,) = camera.openings(diameter[m])
        return camera.pixel_weights((u, v), (1.0, 1.0), lengths[m], np.inf, thickness[m], opening)

    directional = None if optics.edge == "paix" and optics.depth_layers == 1 else effects
    modules = to_array(cameras.rotations, 3, 3).transpose(0, 2, 1), lengths, to_array(effective_diameter), sides
    return PinholeOperator(views, grid, *modules, ray_weight, mu, True, directional)


def camera_views(
    positions: Tensor, rotations: Tensor, distance: Tensor, pitch: Tensor, offset: Tensor, shape: tuple[int, int]
) -> Views:
    """Return cameras (...) as `Views`, one after the other; the arguments are those of `pinhole_rays`, all tensors."""
    numbers = positions, rotations, distance, pitch, offset
    position_array, rotation_array, distance_array, pitch_array, offset_array = (
        x.numpy(force=True).astype(np.float64).reshape(-1, *x.shape[positions.ndim - 1 :]) for x in numbers
    )
    u, v, k = np.moveaxis(rotation_array, 2, 0)
    centers = position_array + distance_array[:, None] * k + offset_array[:, :1] * u + offset_array[:, 1:] * v
    return Views(position_array, centers, pitch_array[:, :1] * u, pitch_array[:, 1:] * v, shape)


def _camera_gradients(A: PinholeOperator, volume: Any, weights: Any, backend: Any, threads: int) -> list[Any]:
    """Return the gradients of sum(weights * A(volume)) by positions, rotations, lengths, diameters, pitches and offsets.

    The diameters are the effective ones.
    """
    centers, frames, numbers = A.gradient(volume[None], weights[None], backend, threads)
    pitch, first = (numbers[name][:, ::-1].copy() for name in ("pitch", "first"))
    return [centers, frames.transpose(0, 2, 1), numbers["length"], numbers["diameter"], pitch, first]
