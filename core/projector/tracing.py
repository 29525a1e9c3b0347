"""Rays given one by one: their line integrals, and in torch the gradients by volume and by the rays' ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import real_array
from ..errors import InputError
from ..grid import Grid
from ..volume import Volume
from . import backends
from .arrays import ArrayOrTensor, alike, checked, is_double, is_tensor, like, together, zeros
from .operator import Spread, _blocks, _parallel, _sum, _thread_count, checked_mu, lattices, volume_workers
from .rays import RayMapper

Points = NDArray[np.float64]


def trace_rays(
    volume: Volume | ArrayOrTensor,
    sources: ArrayLike | ArrayOrTensor,
    targets: ArrayLike | ArrayOrTensor,
    backend: str = "auto",
    grid: Grid | None = None,
    mu: Volume | ArrayOrTensor | None = None,
    mu_grid: Grid | None = None,
) -> ArrayOrTensor:
    """Line integrals of a volume along given rays, attenuated towards their sources if there is mu.

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
    mu
        What attenuates, 1/mm: the integrals are of ``volume exp(-integral of mu from the source)``. A `Volume` of mu,
        or an array or tensor on `mu_grid`.
    mu_grid
        Where mu's voxels are; the volume's grid if None.

    Returns
    -------
    array or tensor (N,)
        Value x mm, from source to target. From arrays: float32, or float64 for ``backend="numpy"``. If anything given
        is a tensor: a tensor of the ends' type (of the volume's where the ends are arrays), computed in float64 if any
        tensor is of float64, and part of torch's graph. Its
        gradients, by the volume, mu and the rays' ends, are exact wherever there are any: by the ends they follow from
        the jumps of the volume and of mu at the planes crossed, for every backend. A ray of length 0 has gradient 0.
        Gradients of gradients are refused.

    Raises
    ------
    InputError
        Not a volume, or the points' shapes do not fit, or a coordinate is not finite; mu is negative; no such backend.

    Examples
    --------
    >>> grid = Grid.centered((3, 3, 3), 1.0)
    >>> source = torch.tensor([0.2, 0.1, -9.0], requires_grad=True)
    >>> trace_rays(np.ones(grid.shape), source, [0.0, 0.0, 9.0], grid=grid).sum().backward()
    """
    array, grid = _field(volume, "volume", grid, None, backend == "numpy")
    if mu is not None:
        if isinstance(mu, Volume) and mu.quantity != "mu":
            raise InputError(f"trace_rays: expected mu to be a volume of mu, got {mu.quantity}")
        mu, mu_grid = _field(mu, "mu", mu_grid, grid, backend == "numpy")
        array, mu = together(array, checked_mu(mu, mu_grid, backend == "numpy"))
    name = backends.choose(backend)
    if is_tensor(array) and array.device.type != "cpu" and backend == "auto":
        name = backends.for_tensor(array)
    float64 = name == "numpy" or any(is_double(value) for value in (array, mu, sources, targets))
    tracer = Tracer(grid, name, mu_grid, float64)
    if any(is_tensor(value) for value in (array, sources, targets)):
        from .autograd import trace

        return trace(array, sources, targets, mu, tracer)
    starts, ends = points(sources, "sources"), points(targets, "targets")
    n = fitting_count(len(starts), len(ends))
    integrals = tracer.integrals(array, np.broadcast_to(starts, (n, 3)), np.broadcast_to(ends, (n, 3)), mu)
    return integrals if backend == "numpy" else integrals.astype(np.float32)


@dataclass(frozen=True)
class Tracer:
    """A backend at work on rays through one volume: numpy points in, numpy numbers out; nothing is checked.

    Attributes
    ----------
    grid : Grid
        The volume's voxels.
    backend : str
        One of `backends.BACKENDS`.
    mu_grid : Grid or None
        The voxels of mu, where that has its own.
    float64 : bool
        Whether arrays are of float64, not float32.
    """

    grid: Grid
    backend: str
    mu_grid: Grid | None = None
    float64: bool = False

    def integrals(self, volume: ArrayOrTensor, starts: Points, ends: Points, mu: ArrayOrTensor = None) -> Points:
        """Line integrals (N,), value x mm."""
        return self._run("forward", volume, starts, ends, mu, (), lambda integrals, along: integrals)

    def derivatives(
        self, volume: ArrayOrTensor, starts: Points, ends: Points, mu: ArrayOrTensor = None
    ) -> tuple[Points, Points, Points]:
        """Line integrals (N,), value x mm, and their derivatives (N, 3), by the source and by the target in world mm."""

        def in_world(rows: Points, along: Points) -> Points:
            length = np.linalg.norm(along, axis=1, keepdims=True)
            along /= np.where(length > 0, length, 1.0)
            # The integral is length x mean, and the mean moves with the planes of either grid.
            mean = by_length = rows[:, :1]
            by_ends = _in_world(rows[:, 1:7], self.grid)
            if mu is not None:  # ... and with the length, which attenuates
                by_ends += _in_world(rows[:, 7:13], self.mu_grid or self.grid)
                by_length = mean + length * rows[:, 13:]
            by_ends *= length
            by_ends[:, :3] -= by_length * along
            by_ends[:, 3:] += by_length * along
            return np.concatenate([length * mean, by_ends], axis=1)

        result = self._run("derivatives", volume, starts, ends, mu, (7,), in_world)
        return result[:, 0], result[:, 1:4], result[:, 4:]

    def adjoint(self, values: ArrayOrTensor, starts: Points, ends: Points, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """`values` (N,) spread along their rays, with the weights of `integrals`, into a volume native to the backend."""
        values = self._native(values)
        _, mapper = self._lattices(values, None, mu)
        return self._spread(backends.load(self.backend).adjoint, self.grid, values, starts, ends, mapper)

    def mu_gradient(
        self, values: ArrayOrTensor, starts: Points, ends: Points, volume: ArrayOrTensor, mu: ArrayOrTensor
    ) -> ArrayOrTensor:
        """The gradient of the sum of `values` (N,) times `integrals` by mu, native to the backend."""
        values = self._native(values)
        box, mapper = self._lattices(values, volume, mu, whole_mu=True)
        add_gradient = backends.load(self.backend).mu_gradient

        def add(gradient: ArrayOrTensor, values: ArrayOrTensor, rays: Any, attenuation: Any) -> None:
            add_gradient(gradient, box, values, rays, attenuation)

        return self._spread(add, self.mu_grid or self.grid, values, starts, ends, mapper)

    def _spread(
        self, add: Spread, grid: Grid, values: ArrayOrTensor, starts: Points, ends: Points, mapper: RayMapper
    ) -> ArrayOrTensor:
        """What ``add(volume, values, rays, attenuation)`` adds to a volume on `grid`, on several threads."""
        workers = volume_workers(self._workers, (8 if self.float64 else 4) * grid.n_voxels)
        volumes = [zeros(grid.shape, values) for _ in range(workers)]
        blocks = _blocks(len(ends), 1, self.backend)

        def work(worker: int) -> None:
            # Always the same blocks, so that the result is always the same.
            for block in blocks[worker::workers]:
                add(volumes[worker], values[block], *mapper.between(starts[block], ends[block]))

        with _parallel(workers) as parallel_map:
            for _ in parallel_map(work, range(workers)):
                pass
        return _sum(volumes)

    def _run(
        self,
        what: str,
        volume: ArrayOrTensor,
        starts: Points,
        ends: Points,
        mu: ArrayOrTensor,
        shape: tuple[int, ...],
        finished: Callable[[Points, Points], Points],
    ) -> Points:
        """A function of the backend on all rays, on several threads; `finished` takes its result and the rays' vectors."""
        function = getattr(backends.load(self.backend), what)
        native = self._native(volume)
        box, mapper = self._lattices(native, native, mu)
        result = np.empty((len(ends), *shape))

        def run(block: slice) -> None:
            rays, attenuation = mapper.between(starts[block], ends[block])
            rows = like(function(box, rays) if attenuation is None else function(box, rays, attenuation), result)
            result[block] = finished(rows, ends[block] - starts[block])

        with _parallel(self._workers) as parallel_map:
            for _ in parallel_map(run, _blocks(len(ends), 1, self.backend)):
                pass
        return result

    def _lattices(
        self, native: ArrayOrTensor, volume: ArrayOrTensor, mu: ArrayOrTensor, whole_mu: bool = False
    ) -> tuple[ArrayOrTensor, RayMapper]:
        """`lattices` with volume and mu as the backend computes with them, as with `native`."""
        volume, mu = (None if x is None else alike(x, native) for x in (volume, mu))
        return lattices(self.grid, volume, mu, self.mu_grid, whole_mu)

    @property
    def _workers(self) -> int:
        return backends.workers(self.backend, _thread_count(None))

    def _native(self, x: ArrayOrTensor) -> Any:
        """`x` as the backend computes with it."""
        return backends.native(x, self.backend, self.float64)


def _in_world(by_ends: Points, grid: Grid) -> Points:
    """Derivatives (n, 6) by start and end, from index space to world mm."""
    return (by_ends.reshape(-1, 3) @ grid.index_from_world[:3, :3]).reshape(-1, 6)


def _field(
    value: Volume | ArrayOrTensor, name: str, grid: Grid | None, default: Grid | None, float64: bool
) -> tuple[ArrayOrTensor, Grid]:
    """The numbers of a `Volume`, or of an array or tensor on `grid`, or else on `default`; and their grid."""
    if isinstance(value, Volume):
        if grid is not None and grid != value.grid:
            raise InputError(f"trace_rays: {name} is a Volume and has a grid; leave the other out")
        return value.array, value.grid
    grid = grid or default
    if grid is None:
        raise InputError(f"trace_rays: expected a Volume, or also a grid, got {type(value).__name__}")
    if not isinstance(grid, Grid):
        raise InputError(f"trace_rays: expected grid to be Grid, got {type(grid).__name__}")
    return checked(value, name, grid.shape, float64), grid


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
