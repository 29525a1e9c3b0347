"""Pinhole images from poses in torch, so that poses can be optimised.

`Views` describes cameras that stand still, in numpy; the rays made here from torch tensors are the same, part of torch's
graph. Needs torch.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ..checks import whole_shape
from ..errors import InputError
from ..grid import Grid
from ..volume import Volume
from .tracing import trace_rays

Numbers = Any  # a tensor, an array or numbers


def pinhole_rays(
    positions: Tensor,
    rotations: Numbers,
    distance: Numbers,
    pitch: Numbers,
    shape: tuple[int, int],
    offset: Numbers = (0.0, 0.0),
) -> tuple[Tensor, Tensor]:
    """Rays of pinhole cameras, differentiable in everything that is a number of theirs.

    Parameters
    ----------
    positions
        Pinholes (..., 3), world mm.
    rotations
        World from camera, (..., 3, 3), columns u, v, k as in ``system.poses()``: k looks from the pinhole to the detector's
        plane, columns of the image grow along u, rows along v.
    distance
        Pinhole to the detector's plane along k, mm, (...) or one number: magnification times collimator length for a
        virtual detector.
    pitch
        From pixel to pixel on that plane, mm, (..., 2) for u and v, or one number for both.
    shape
        Pixels (n_v, n_u): rows, columns.
    offset
        (..., 2): u and v, mm, of the image's middle on that plane, seen from where k meets it (the principal point).

    Returns
    -------
    sources, targets : tensors (..., n_v * n_u, 3)
        Ends of the rays to the pixels' centres, row by row, world mm.

    Raises
    ------
    InputError
        Shapes that do not fit.
    """
    n_v, n_u = whole_shape(shape, "image shape", 2)
    if not isinstance(positions, Tensor) or positions.shape[-1:] != (3,) or not positions.is_floating_point():
        raise InputError("positions: expected a tensor of real numbers, ... x 3")

    given = (positions, rotations, distance, pitch, offset)
    kinds = [x.dtype for x in given if isinstance(x, Tensor) and x.is_floating_point()]
    kind = functools.reduce(torch.promote_types, kinds)
    positions, rotations, distance, pitch, offset = (torch.as_tensor(x).to(positions.device, kind) for x in given)
    if rotations.shape[-2:] != (3, 3):
        raise InputError(f"rotations: expected ... x 3 x 3, got {' x '.join(map(str, rotations.shape))}")
    column = torch.arange(n_u).to(positions) - (n_u - 1) / 2
    row = torch.arange(n_v).to(positions) - (n_v - 1) / 2
    row, column = (x.reshape(-1) for x in torch.meshgrid(row, column, indexing="ij"))
    pitch, offset = (x.expand(*x.shape[:-1], 2) if x.ndim else x.expand(2) for x in (pitch, offset))
    try:
        u = column * pitch[..., :1] + offset[..., :1]
        v = row * pitch[..., 1:] + offset[..., 1:]
        in_camera = torch.stack(torch.broadcast_tensors(u, v, distance[..., None]), dim=-1)
        targets = positions[..., None, :] + in_camera @ rotations.mT
    except RuntimeError as error:
        raise InputError(f"pinhole rays: {str(error).splitlines()[0]}") from None
    return positions[..., None, :].expand(targets.shape), targets


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
    """Line integrals (..., n_v, n_u), value x mm, of a volume seen by cameras as of `pinhole_rays`.

    Differentiable by the volume (a tensor on `grid`) and by all the cameras' numbers; `backend` as of `Projector`.

    Examples
    --------
    >>> position = torch.tensor([0.0, 0.0, -200.0], requires_grad=True)
    >>> volume = Volume(np.ones((8, 8, 8)), Grid.centered(8, 4.0))
    >>> image = pinhole_images(volume, position, torch.eye(3), distance=400.0, pitch=2.0, shape=(32, 32))
    >>> image.sum().backward()
    """
    sources, targets = pinhole_rays(positions, rotations, distance, pitch, shape, offset)
    integrals = trace_rays(volume, sources.reshape(-1, 3), targets.reshape(-1, 3), backend, grid)
    return integrals.reshape(*targets.shape[:-2], *shape)
