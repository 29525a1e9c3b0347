"""Pinhole cameras in torch: rays, radiographs and counts that are differentiable by the cameras' poses. Needs torch.

`Views` and `Emission` describe cameras that stand still, in numpy; the rays and counts computed here from torch tensors are
the same, as part of torch's graph.
"""

import functools
import itertools
import math
from typing import Any, Literal

import torch
from torch import Tensor

from ..arrays import is_tensor, require_numbers, uncompiled
from ..errors import InputError
from ..geometry.grid import Grid
from ..models.pixel_points import TOLERANCE, lattice, lattices, points_needed, require_points, shadow_edges
from ..physics.optics import Optics, chosen_optics
from ..rays.tracing import trace_fans
from ..validation import positive, whole_shape
from ..volumes.volume import Volume, require_quantity
from .torch_depth_images import CameraTensors, camera_views, depth_images

# Rays of a camera that are traced at once.
_RAYS_AT_ONCE = 2**20

Numbers = Any  # a tensor, an array or numbers


def pinhole_rays(
    positions: Tensor,
    rotations: Numbers,
    distance: Numbers,
    pitch: Numbers,
    shape: tuple[int, int],
    offset: Numbers = (0.0, 0.0),
) -> tuple[Tensor, Tensor]:
    """Return the rays of pinhole cameras (...), differentiable by all numbers of the cameras.

    Parameters
    ----------
    positions
        Positions of the pinholes, (..., 3), world mm.
    rotations
        Rotations from camera to world, (..., 3, 3), columns u, v, k as in ``system.poses()``: k looks from the pinhole to
        the detector's plane, columns of the image grow along u, rows along v.
    distance
        Distance from the pinhole to the detector's plane along k, mm, (...) or one number: magnification times collimator
        length for a virtual detector.
    pitch
        Step from pixel to pixel on that plane, mm, (..., 2) for u and v, or one number for both.
    shape
        Number of pixels (n_v, n_u): rows, columns.
    offset
        Position u and v, (..., 2), mm, of the image's middle on that plane, from where k meets it (the principal point).

    Returns
    -------
    sources, targets : tensors (..., n_v * n_u, 3)
        Ends of the rays to the pixels' centres, row by row, world mm.

    """
    n_v, n_u = whole_shape(shape, "image shape", 2)
    positions, rotations, distance, pitch, offset = _cameras(positions, rotations, distance, pitch, offset)
    v, u = _pixels(pitch, offset, (n_v, n_u))
    v, u = v[..., :, None].expand(*v.shape, n_u), u[..., None, :].expand(*u.shape[:-1], n_v, n_u)
    in_camera = torch.stack((u, v, distance[..., None, None].expand_as(u)), dim=-1).flatten(-3, -2)
    targets = positions[..., None, :] + in_camera @ rotations.mT
    return positions[..., None, :].expand(targets.shape), targets


def _cameras(positions: Tensor, rotations: Numbers, *numbers: Numbers) -> list[Tensor]:
    """Return the numbers of cameras as tensors of one type: positions (..., 3), rotations (..., 3, 3), numbers (...).

    The last two of the numbers are pitch and offset, (..., 2). Raise `InputError` where their axes do not fit.
    """
    if not isinstance(positions, Tensor) or positions.shape[-1:] != (3,) or not positions.is_floating_point():
        raise InputError("positions: expected a tensor of real numbers, ... x 3")
    values = (positions, rotations, *numbers)
    dtypes = [x.dtype for x in values if isinstance(x, Tensor) and x.is_floating_point()]
    options: Any = {"device": positions.device, "dtype": functools.reduce(torch.promote_types, dtypes)}
    tensors = [x.to(**options) if isinstance(x, Tensor) else torch.tensor(x, **options) for x in values]
    if tensors[1].shape[-2:] != (3, 3):
        raise InputError(f"rotations: expected ... x 3 x 3, got {' x '.join(map(str, tensors[1].shape))}")
    tensors[-2:] = (x if x.ndim else x.expand(2) for x in tensors[-2:])  # pitch, offset: one number for both
    shapes = [(3,), (3, 3), *[()] * (len(numbers) - 2), (2,), (2,)]
    try:
        cameras = torch.broadcast_shapes(*(x.shape[: x.ndim - len(s)] for x, s in zip(tensors, shapes, strict=True)))
        return [x.expand((*cameras, *s)) for x, s in zip(tensors, shapes, strict=True)]
    except RuntimeError as error:
        raise InputError(f"pinhole rays: {str(error).splitlines()[0]}") from None


def _pixels(pitch: Tensor, offset: Tensor, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return the centres of rows along v (..., n_v) and of columns along u (..., n_u), mm."""
    row, column = (torch.arange(n).to(pitch) - (n - 1) / 2 for n in shape)
    return row * pitch[..., 1:] + offset[..., 1:], column * pitch[..., :1] + offset[..., :1]


def _fans(
    shape: tuple[int, int], positions: Tensor, rotations: Tensor, distance: Tensor, pitch: Tensor, offset: Tensor
) -> Tensor:
    """Return the rays of `pinhole_rays` as the vectors (..., 4, 3) of `trace_fans`, rows and columns as in the image."""
    u, v, k = rotations.unbind(dim=-1)
    pitch_u, pitch_v = pitch[..., :1], pitch[..., 1:]
    first_u, first_v = (offset - pitch * (pitch.new_tensor([shape[1], shape[0]]) - 1) / 2).split(1, dim=-1)
    corners = positions + first_u * u + first_v * v + distance[..., None] * k
    return torch.stack((positions, corners, pitch_v * v, pitch_u * u), dim=-2)


@uncompiled
def pinhole_images(
    volume: Volume | Tensor,
    positions: Tensor,
    rotations: Numbers,
    distance: Numbers,
    pitch: Numbers,
    shape: tuple[int, int],
    offset: Numbers = (0.0, 0.0),
    *,
    backend: str = "auto",
    grid: Grid | None = None,
) -> Tensor:
    """Return line integrals (..., n_v, n_u), value x mm, of a volume seen by the cameras of `pinhole_rays`.

    They are differentiable by the volume (a tensor on `grid`) and by all numbers of the cameras; `backend` is one of
    `Projector`'s.

    Examples
    --------
    >>> position = torch.tensor([0.0, 0.0, -200.0], requires_grad=True)
    >>> volume = Volume(np.ones((8, 8, 8)), Grid.centered(8, 4.0))
    >>> image = pinhole_images(volume, position, torch.eye(3), distance=400.0, pitch=2.0, shape=(32, 32))
    >>> image.sum().backward()
    """
    shape = whole_shape(shape, "image shape", 2)
    cameras = _cameras(positions, rotations, distance, pitch, offset)
    return trace_fans(volume, _fans(shape, *cameras), shape, backend, grid)


@uncompiled
def emission_images(
    volume: Volume | Tensor,
    positions: Tensor,
    rotations: Numbers,
    collimator_length: Numbers,
    pitch: Numbers,
    shape: tuple[int, int],
    offset: Numbers = (0.0, 0.0),
    *,
    diameter: Numbers,
    aperture_points: int = 1,
    pixel_points: int | None = None,
    tolerance: float = TOLERANCE,
    crystal_thickness: Numbers | None = None,
    crystal_side: Numbers | None = None,
    time: Numbers = 1.0,
    mu: Volume | Tensor | None = None,
    mu_grid: Grid | None = None,
    hole: Literal["rays", "depth"] = "rays",
    backend: str = "auto",
    grid: Grid | None = None,
    optics: Optics | None = None,
    **settings: Any,
) -> Tensor:
    """Return the expected counts (..., n_v, n_u) of pinhole cameras, by the law of `Emission`.

    They are differentiable by the volume, by mu, and by all numbers of the cameras. Images are upright, as on a virtual
    detector of magnification 1: those of a real detector are point-inverted. For an intrinsic blur take whole
    parts of the pixels, and multiply the images by the matrices of `gaussian_blur`.

    Parameters
    ----------
    volume
        Activity, kBq/mL: a `Volume`, or a tensor on `grid`.
    positions, rotations
        Positions of the pinholes and rotations from camera to world, as in `pinhole_rays`.
    collimator_length
        Distance from pinhole to crystal, mm, (...) or one number.
    pitch, offset
        Pitch and offset of `pinhole_rays`, on the upright image at `collimator_length` in front of the pinhole: mm of the
        crystal.
    shape
        Number of pixels (n_v, n_u): rows, columns.
    diameter
        Diameter of the hole, mm, (...) or one number: the effective one, unless `aperture_mu` says how photons penetrate
        the edge.
    aperture_points, pixel_points, tolerance
        Settings of rays as in `Emission`; without a number of pixel points all cameras get as many as the one that needs
        most. All rays of a camera are in the graph: many points of small images take less memory than few of large ones.
    crystal_thickness, crystal_side
        Thickness and side of the crystal, mm, (...) or one number: needed with `crystal_mu`, and with `within_crystal` or
        `within_walls`.
    time
        Duration of the acquisition, s, (...) or one number.
    mu, mu_grid
        Attenuation coefficients, 1/mm, and their grid, as in `trace_rays`.
    hole
        "rays": lines through points of the hole. "depth": the depth-dependent response, with the blur of the whole hole and
        its limits in `Emission`; on the processor. It has no derivatives by `crystal_mu`, `crystal_thickness` and
        `crystal_side`, nor with edge "path" by `aperture_mu` and `opening_angle`.
    backend, grid
        Backend of the rays, and grid of a volume that is a tensor, as in `trace_rays`.
    optics, settings
        Optics as in `sensitivity`: `crystal_mu`, `photons_per_decay` and so on, each (...) or one number, without
        `intrinsic_fwhm`.

    Examples
    --------
    >>> position = torch.tensor([0.0, 0.0, -200.0], requires_grad=True)
    >>> activity = Volume(np.ones((8, 8, 8)), Grid.centered(8, 4.0), "activity")
    >>> counts = emission_images(activity, position, torch.eye(3), 60.0, 1.5, (32, 32), diameter=2.0)
    >>> counts.sum().backward()
    """
    n_v, n_u = whole_shape(shape, "image shape", 2)
    if isinstance(volume, Volume):
        require_quantity(volume.quantity, ("activity",), "emission images")
    volume_grid = volume.grid if isinstance(volume, Volume) else grid
    if not isinstance(volume_grid, Grid):
        raise InputError(f"emission images: expected a Volume, or also a grid, got {type(volume).__name__}")
    optics = chosen_optics(optics, settings)
    if (optics.crystal_mu is None) != (crystal_thickness is None):
        raise InputError("emission images: crystal_mu and crystal_thickness belong together")
    if (optics.within_crystal or optics.within_walls) != (crystal_side is not None):
        raise InputError("emission images: crystal_side and within_crystal or within_walls belong together")
    if aperture_points < 1 or aperture_points == 2:
        raise InputError(f"emission images: aperture_points: expected 1, 3 or more, got {aperture_points}")
    if not isinstance(optics.intrinsic_fwhm, float) or optics.intrinsic_fwhm > 0:
        raise InputError("emission images: intrinsic_fwhm: expected 0; `gaussian_blur` makes the matrices of a blur")
    settings_by_name = optics.numbers
    crystal = [0.0 if x is None else x for x in (crystal_thickness, crystal_side)]
    cameras = _cameras(
        positions, rotations, collimator_length, diameter, *crystal, time, *settings_by_name.values(), pitch, offset
    )
    for x in filter(is_tensor, (volume, mu, *cameras)):
        require_numbers(x, "emission images")
    positions, rotations, l, diameter, thickness, side, time, *optics_numbers, pitch, offset = cameras
    named_numbers = dict(zip(settings_by_name, optics_numbers, strict=True))
    for name, x in (("collimator_length", l), ("diameter", diameter), ("pitch", pitch)):
        if bool((x <= 0).any()):
            raise InputError(f"emission images: {name}: expected more than 0 mm, got {float(x.min()):g}")

    if hole not in ("rays", "depth"):
        raise InputError(f"emission images: hole: expected 'rays' or 'depth', got {hole!r}")
    if hole == "depth":
        if aperture_points != 1 or pixel_points is not None:
            raise InputError("emission images: hole 'depth' takes no aperture_points and pixel_points")
        bounded_side = side if optics.within_crystal or optics.within_walls else None
        pinholes = CameraTensors(positions, rotations, l, diameter, bounded_side, thickness, pitch, offset)
        optics = optics.with_numbers(named_numbers)
        return depth_images(volume, volume_grid, pinholes, (n_v, n_u), time, mu, mu_grid, optics)

    # Depth of the plane through the grid's farthest corner, in units of the distance from pinhole to crystal.
    corners = positions.new_tensor(volume_grid.corners()) - positions.detach()[..., None, :]
    depth = ((corners @ rotations.detach()[..., 2:])[..., 0].amax(dim=-1) / l.detach()).clamp(min=1.0)
    if (n := require_points(pixel_points, "emission images: pixel_points")) is None:
        views = camera_views(positions, rotations, l, pitch, offset, (n_v, n_u))
        edges = [shadow_edges(views, m, volume_grid) for m in range(len(views))]
        error = positive(tolerance, "tolerance")
        n = max(points_needed(view_edges, error, aperture_points) for view_edges in edges)
    # Numbers of cameras get axes for rays, rows and columns: (..., 1, 1, 1).
    optics = optics.with_numbers({name: x[..., None, None, None] for name, x in named_numbers.items()})
    numbers = l, diameter, side, thickness, time, *pitch.unbind(dim=-1)
    length, d, side, thickness, seconds, pitch_u, pitch_v = (x[..., None, None, None] for x in numbers)
    openings = optics.openings(d, aperture_points)
    starts = zip(openings, lattices(aperture_points, len(openings)), strict=True)
    distance = positions.norm(dim=-1)  # to the isocentre
    images: Any = 0.0
    for (layer, z), (opening, start) in itertools.product(enumerate(optics.depths(thickness)), starts):
        point = torch.stack([(x + 0 * d)[..., 0, 0, 0] for x in (opening.x, opening.y)], dim=-1)
        sources = positions + (rotations[..., :2] @ point[..., None])[..., 0]
        points = pitch.new_tensor(lattice(n)).expand(*pitch.shape[:-1], n, 2)
        if len(openings) > 1:  # as in `Emission`: seen from the isocentre they fill the pixel evenly
            shift = pitch.new_tensor(start) / math.sqrt(n) - (1 + l / distance)[..., None] * point / pitch
            points = (points + shift[..., None, :] + 0.5) % 1 - 0.5
        stretch = depth * l / (l + z[..., 0, 0, 0])
        for chunk in points.split(max(1, _RAYS_AT_ONCE // (n_v * n_u)), dim=-2):
            ends = offset[..., None, :] + pitch[..., None, :] * chunk
            v, u = _pixels(pitch[..., None, :], ends, (n_v, n_u))
            along = u[..., None, :], v[..., :, None]
            cells = n * len(openings)
            rates = optics.pixel_weights(along, (pitch_u, pitch_v), length, side, thickness, opening, layer, cells)
            weights = rates * seconds / n
            middle = ends + point[..., None, :]
            axes = middle.shape[:-1]
            pinholes, frames = sources[..., None, :].expand(*axes, 3), rotations[..., None, :, :].expand(*axes, 3, 3)
            distances, pitches = (depth * l)[..., None].expand(axes), (stretch[..., None] * pitch)[..., None, :]
            offsets = stretch[..., None, None] * middle
            vectors = _fans((n_v, n_u), pinholes, frames, distances, pitches.expand(middle.shape), offsets)
            integrals = trace_fans(volume, vectors, (n_v, n_u), backend, grid, mu, mu_grid)
            images = images + (weights.to(integrals) * integrals).sum(dim=-3)
    return images
