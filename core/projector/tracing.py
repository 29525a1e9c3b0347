"""Rays given one by one: their line integrals, and in torch the gradients by volume and by the rays' ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import real_array
from ..errors import InputError
from ..grid import Grid
from ..volume import Volume
from . import backends
from .arrays import ArrayOrTensor, checked, cropped, is_tensor, like, to_numpy, to_tensor
from .operator import _blocks, _parallel, _thread_count
from .rays import index_rays

Points = NDArray[np.float64]


def trace_rays(
    volume: Volume | ArrayOrTensor,
    sources: ArrayLike | ArrayOrTensor,
    targets: ArrayLike | ArrayOrTensor,
    backend: str = "auto",
    grid: Grid | None = None,
) -> ArrayOrTensor:
    """Line integrals of a volume along given rays.

    Parameters
    ----------
    volume
        The voxels; outside them it is 0. A `Volume`, or an array or tensor (n_x, n_y, n_z) on `grid`.
    sources, targets
        Ends of the rays, each (N, 3), or (3,) for all rays the same; world mm. Arrays or torch tensors.
    backend
        As of `Projector`.
    grid
        Where the voxels are, for a volume that is an array or a tensor.

    Returns
    -------
    array or tensor (N,)
        Value x mm, from source to target. From arrays: float32, or float64 for ``backend="numpy"``. If anything given
        is a tensor: a tensor of the ends' type (of the volume's where the ends are arrays), part of torch's graph. Its
        gradients are exact wherever there are any: by the ends they follow from the jumps of the volume at the
        planes crossed, for every backend. A ray of length 0 has gradient 0. Gradients of gradients are refused.

    Raises
    ------
    InputError
        Not a volume, or the points' shapes do not fit, or a coordinate is not finite; no such backend.

    Examples
    --------
    >>> grid = Grid.centered((3, 3, 3), 1.0)
    >>> source = torch.tensor([0.2, 0.1, -9.0], requires_grad=True)
    >>> trace_rays(np.ones(grid.shape), source, [0.0, 0.0, 9.0], grid=grid).sum().backward()
    """
    array: ArrayOrTensor
    if isinstance(volume, Volume):
        if grid is not None and grid != volume.grid:
            raise InputError("trace_rays: a Volume has a grid; leave `grid` out")
        array, grid = volume.array, volume.grid
    elif grid is None:
        raise InputError(f"trace_rays: expected a Volume, or also a grid, got {type(volume).__name__}")
    elif not isinstance(grid, Grid):
        raise InputError(f"trace_rays: expected grid to be Grid, got {type(grid).__name__}")
    else:
        array = checked(volume, "volume", grid.shape, backend == "numpy")
    name = backends.choose(backend)
    if is_tensor(array) and array.device.type != "cpu" and backend == "auto":
        name = backends.for_tensor(array)
    if any(is_tensor(value) for value in (array, sources, targets)):
        from .autograd import trace

        return trace(array, sources, targets, Tracer(grid, name))
    starts, ends = points(sources, "sources"), points(targets, "targets")
    n = fitting_count(len(starts), len(ends))
    starts, ends = np.broadcast_to(starts, (n, 3)), np.broadcast_to(ends, (n, 3))
    integrals = Tracer(grid, name).integrals(array, starts, ends)
    return integrals if backend == "numpy" else integrals.astype(np.float32)


@dataclass(frozen=True)
class Tracer:
    """A backend at work on rays through one grid: numpy points in, numpy numbers out; nothing is checked.

    Attributes
    ----------
    grid : Grid
        The voxels.
    backend : str
        One of `backends.BACKENDS`.
    """

    grid: Grid
    backend: str

    def integrals(self, volume: ArrayOrTensor, starts: Points, ends: Points) -> Points:
        """Line integrals (N,), value x mm."""
        return self._run("forward", volume, starts, ends, ())

    def derivatives(self, volume: ArrayOrTensor, starts: Points, ends: Points) -> tuple[Points, Points, Points]:
        """Line integrals (N,), value x mm, and their derivatives (N, 3), by the source and by the target in world mm."""
        result = self._run("derivatives", volume, starts, ends, (7,))
        mean, by_start, by_end = result[:, :1], result[:, 1:4], result[:, 4:]
        along = ends - starts
        length = np.linalg.norm(along, axis=1, keepdims=True)
        along /= np.where(length > 0, length, 1.0)
        index_from_world = self.grid.index_from_world[:3, :3]
        # integral = length x mean, and both move with the ends.
        return (
            (length * mean)[:, 0],
            length * np.einsum("ni,ij->nj", by_start, index_from_world) - mean * along,
            length * np.einsum("ni,ij->nj", by_end, index_from_world) + mean * along,
        )

    def adjoint(self, values: ArrayOrTensor, starts: Points, ends: Points) -> ArrayOrTensor:
        """`values` (N,) spread along their rays, with the weights of `integrals`, into a volume native to the backend."""
        values = self._native(values)
        volume = values.new_zeros(self.grid.shape) if is_tensor(values) else np.zeros(self.grid.shape, values.dtype)
        for block in _blocks(len(ends), 1, self.backend):
            rays = index_rays(self.grid, starts[block], ends[block])
            backends.load(self.backend).adjoint(volume, values[block], rays)
        return volume

    def _run(self, what: str, volume: ArrayOrTensor, starts: Points, ends: Points, shape: tuple[int, ...]) -> Points:
        """A function of the backend on all rays, on several threads."""
        function = getattr(backends.load(self.backend), what)
        # Empty margins cost time: most objects fill a small part of their grid.
        (box,), origin = cropped(self._native(volume))
        result = np.empty((len(ends), *shape))

        def run(block: slice) -> None:
            result[block] = like(function(box, index_rays(self.grid, starts[block], ends[block], origin)), result)

        with _parallel(1 if self.backend in ("torch", "cuda") else _thread_count(None)) as parallel_map:
            for _ in parallel_map(run, _blocks(len(ends), 1, self.backend)):
                pass
        return result

    def _native(self, x: ArrayOrTensor) -> Any:
        """`x` as the backend computes with it."""
        if self.backend == "torch":
            return to_tensor(x)
        if self.backend == "cuda":
            return backends.load("cuda").native(x)
        return to_numpy(x, np.float64 if self.backend == "numpy" else np.float32)


def fitting_count(n_sources: int, n_targets: int) -> int:
    """How many rays `n_sources` sources and `n_targets` targets are; one of either serves all of the other.

    Raises
    ------
    InputError
        Neither as many nor one.
    """
    if n_sources != n_targets and 1 not in (n_sources, n_targets):
        raise InputError(f"trace_rays: {n_sources} sources but {n_targets} targets")
    return n_targets if n_sources == 1 else n_sources


def points(value: ArrayLike, name: str) -> Points:
    """`value`, one point (3,) or many (n, 3), as an array (n, 3), or `InputError`."""
    try:
        shape = np.shape(value)
    except ValueError:  # ragged: real_array says so
        shape = ()
    if shape == (0,):  # an empty list
        return np.empty((0, 3))
    return real_array(value, name, (3,))[None] if len(shape) == 1 else real_array(value, name, (None, 3))
