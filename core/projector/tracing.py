"""Rays given by their ends, or fan by fan: line integrals, and in torch the gradients by the volume and by the rays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import ArrayOrTensor, checked, is_double, is_tensor, like, together, zeros
from ..errors import InputError
from ..geometry.grid import Grid
from ..validation import real_array, whole_shape
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from . import backends
from .operator import Spread, _blocks, _parallel, _sum, _thread_count, checked_mu, lattices, volume_workers
from .rays import Attenuation, Fan, RayMapper, Rays

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
        The voxels; outside them it is 0. A `Volume` of activity or mu (with `mu`, of activity), or an array or tensor
        (n_x, n_y, n_z) on `grid`.
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
        Not a volume, or one whose line integrals mean nothing (CT numbers, maps); the points' shapes do not fit, or a
        coordinate is not finite; mu is negative; no such backend.

    Examples
    --------
    >>> grid = Grid.centered((3, 3, 3), 1.0)
    >>> source = torch.tensor([0.2, 0.1, -9.0], requires_grad=True)
    >>> trace_rays(np.ones(grid.shape), source, [0.0, 0.0, 9.0], grid=grid).sum().backward()
    """
    array, mu, tracer = _tracer(volume, backend, grid, mu, mu_grid, (sources, targets))
    if any(is_tensor(value) for value in (array, sources, targets)):
        from . import autograd

        return autograd.trace_rays(array, sources, targets, mu, tracer)
    starts, ends = points(sources, "sources"), points(targets, "targets")
    n = fitting_count(len(starts), len(ends))
    rays = Ends(np.broadcast_to(starts, (n, 3)), np.broadcast_to(ends, (n, 3)))
    integrals = tracer.integrals(array, [rays], mu).reshape(n)
    return integrals if backend == "numpy" else integrals.astype(np.float32)


def trace_fans(
    volume: Volume | ArrayOrTensor,
    vectors: ArrayLike | ArrayOrTensor,
    shape: tuple[int, int],
    backend: str = "auto",
    grid: Grid | None = None,
    mu: Volume | ArrayOrTensor | None = None,
    mu_grid: Grid | None = None,
) -> ArrayOrTensor:
    """Line integrals along fans of rays: `trace_rays` for images, whose rays need not be listed.

    Parameters
    ----------
    vectors
        The fans, (..., 4, 3), world mm: source, corner, line step and ray step. Ray j of line i goes from the source to
        ``corner + i line_step + j ray_step``. An array or a torch tensor.
    shape
        Lines, and rays of a line.
    volume, backend, grid, mu, mu_grid
        As of `trace_rays`.

    Returns
    -------
    array or tensor (..., lines, rays)
        As of `trace_rays`. Gradients by the vectors cost little more than the integrals.

    Raises
    ------
    InputError
        As of `trace_rays`.

    Examples
    --------
    >>> grid = Grid.centered((3, 3, 3), 1.0)
    >>> fan = torch.tensor([[0.0, 0.0, -9.0], [-2.0, -2.0, 9.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], requires_grad=True)
    >>> trace_fans(np.ones(grid.shape), fan, (5, 5), grid=grid).sum().backward()
    """
    n_lines, n_rays = whole_shape(shape, "shape of a fan", 2)
    array, mu, tracer = _tracer(volume, backend, grid, mu, mu_grid, (vectors,))
    if is_tensor(array) or is_tensor(vectors):
        from . import autograd

        return autograd.trace_fans(array, vectors, (n_lines, n_rays), mu, tracer)
    numbers = fan_vectors(vectors, "vectors")
    integrals = tracer.integrals(array, fans(numbers, (n_lines, n_rays)), mu)
    integrals = integrals.reshape(*numbers.shape[:-2], n_lines, n_rays)
    return integrals if backend == "numpy" else integrals.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Ends:
    """Rays from point to point; like a `Fan` of lines of one ray.

    Attributes
    ----------
    starts, ends : array (N, 3)
        World mm.
    """

    starts: Points
    ends: Points

    @property
    def shape(self) -> tuple[int, int]:
        """N lines of one ray."""
        return len(self.ends), 1

    def __getitem__(self, lines: slice) -> Ends:
        """Some of the rays."""
        return Ends(self.starts[lines], self.ends[lines])


Bundle = Fan | Ends


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some lines of a bundle, as many as a backend is given at once.

    Attributes
    ----------
    number : int
        Of the bundle.
    bundle : Fan or Ends
        All of it.
    lines : slice
        Which of its lines.
    transposed : bool
        Whether its lines are the columns of arrays of its rays.
    """

    number: int
    bundle: Bundle
    lines: slice
    transposed: bool

    def on(self, mapper: RayMapper) -> tuple[Rays, Attenuation | None]:
        """The rays, and what attenuates them, for a backend."""
        rays = self.bundle[self.lines]
        return mapper(rays) if isinstance(rays, Fan) else mapper.between(rays.starts, rays.ends)

    def of(self, values: ArrayOrTensor) -> ArrayOrTensor:
        """The part (lines, rays) of `values` (bundles, lines, rays)."""
        lines = values[self.number]
        return (lines.T if self.transposed else lines)[self.lines]


@dataclass(frozen=True)
class Tracer:
    """A backend at work on rays through one volume; nothing is checked.

    Rays are bundles of one shape, (lines, rays), for what has a value for every ray, (bundles, lines, rays).

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

    def integrals(self, volume: ArrayOrTensor, bundles: Sequence[Bundle], mu: ArrayOrTensor = None) -> Points:
        """Line integrals, value x mm."""
        result = _empty(bundles)

        def finish(piece: _Piece, integrals: Points) -> None:
            part = piece.of(result)
            part[...] = integrals.reshape(part.shape)

        self._run("forward", volume, bundles, mu, finish)
        return result

    def derivatives(
        self, volume: ArrayOrTensor, bundles: Sequence[Bundle], mu: ArrayOrTensor = None
    ) -> tuple[Points, list[Points]]:
        """Line integrals, and what `gradients` needs: the backend's derivatives, piece by piece, (7 or 14, n)."""
        result = _empty(bundles)

        def finish(piece: _Piece, derivatives: Points) -> Points:
            part = piece.of(result)
            part[...] = (_lengths(piece) * derivatives[:, 0]).reshape(part.shape)
            return derivatives.T

        return result, self._run("derivatives", volume, bundles, mu, finish)

    def gradients(self, values: Points, derivatives: list[Points], bundles: Sequence[Bundle]) -> list[Points]:
        """The gradient of the sum of `values` times `integrals` by what the bundles consist of, world mm.

        Of each bundle: by a fan's source, corner, line step and ray step, (4, 3); by starts and ends, (2, N, 3).
        """
        pieces = self._pieces(bundles)

        def of_piece(which: int) -> Points:
            piece = pieces[which]
            by = _by_fan if isinstance(piece.bundle, Fan) else _by_ends
            return by(piece, piece.of(values).reshape(-1), derivatives[which], self.grid, self.mu_grid or self.grid)

        with _parallel(self._workers) as parallel_map:
            parts = list(parallel_map(of_piece, range(len(pieces))))
        of_bundles: list[list[Points]] = [[] for _ in bundles]
        for piece, part in zip(pieces, parts, strict=True):
            of_bundles[piece.number].append(part)
        return [
            np.sum(own, axis=0) if isinstance(bundle, Fan) else np.concatenate([np.empty((2, 0, 3)), *own], axis=1)
            for bundle, own in zip(bundles, of_bundles, strict=True)
        ]

    def adjoint(self, values: ArrayOrTensor, bundles: Sequence[Bundle], mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """`values` spread along their rays, with the weights of `integrals`, into a volume native to the backend."""
        values = self._native(values)
        _, mapper = self._lattices(None, mu)
        return self._spread(backends.load(self.backend).adjoint, self.grid, values, bundles, mapper)

    def mu_gradient(
        self, values: ArrayOrTensor, bundles: Sequence[Bundle], volume: ArrayOrTensor, mu: ArrayOrTensor
    ) -> ArrayOrTensor:
        """The gradient of the sum of `values` times `integrals` by mu, native to the backend."""
        values = self._native(values)
        box, mapper = self._lattices(volume, mu, whole_mu=True)
        add_gradient = backends.load(self.backend).mu_gradient

        def add(gradient: ArrayOrTensor, values: ArrayOrTensor, rays: Any, attenuation: Any) -> None:
            add_gradient(gradient, box, values, rays, attenuation)

        return self._spread(add, self.mu_grid or self.grid, values, bundles, mapper)

    def _spread(
        self, add: Spread, grid: Grid, values: ArrayOrTensor, bundles: Sequence[Bundle], mapper: RayMapper
    ) -> ArrayOrTensor:
        """What ``add(volume, values, rays, attenuation)`` adds to a volume on `grid`, on several threads."""
        workers = volume_workers(self._workers, (8 if self.float64 else 4) * grid.n_voxels)
        pieces = self._pieces(bundles)
        with _parallel(workers) as parallel_map:
            volumes = list(parallel_map(lambda _: zeros(grid.shape, values), range(workers)))

            def work(worker: int) -> None:
                # Always the same pieces, so that the result is always the same.
                for piece in pieces[worker::workers]:
                    add(volumes[worker], piece.of(values).reshape(-1), *piece.on(mapper))

            for _ in parallel_map(work, range(workers)):
                pass
            return _sum(volumes, parallel_map)

    def _run(
        self,
        what: str,
        volume: ArrayOrTensor,
        bundles: Sequence[Bundle],
        mu: ArrayOrTensor,
        finish: Callable[[_Piece, Points], Any],
    ) -> list[Any]:
        """What `finish` makes of a backend's function of every piece, on several threads."""
        function = getattr(backends.load(self.backend), what)
        box, mapper = self._lattices(volume, mu)

        def run(piece: _Piece) -> Any:
            return finish(piece, like(function(box, *piece.on(mapper)), np.empty(0)))

        with _parallel(self._workers) as parallel_map:
            return list(parallel_map(run, self._pieces(bundles)))

    def _pieces(self, bundles: Sequence[Bundle]) -> list[_Piece]:
        """The bundles' lines, cut; those of a fan follow the volume's contiguous axis as well as they can."""
        pieces = []
        for number, bundle in enumerate(bundles):
            transposed = False
            if isinstance(bundle, Fan) and bundle.lies_across(self.grid):
                bundle, transposed = bundle.transposed(), True
            pieces += [
                _Piece(number, bundle, lines, transposed)
                for lines in _blocks(slice(0, bundle.shape[0]), slice(0, bundle.shape[1]), self.backend, self._workers)
            ]
        return pieces

    def _lattices(
        self, volume: ArrayOrTensor, mu: ArrayOrTensor, whole_mu: bool = False
    ) -> tuple[ArrayOrTensor, RayMapper]:
        """`lattices` with what is left of volume and mu as the backend computes with it."""
        box, mapper = lattices(self.grid, volume, mu, self.mu_grid, whole_mu)
        box, mu = (None if x is None else self._native(x) for x in (box, mapper.mu))
        return box, replace(mapper, mu=mu)

    @property
    def _workers(self) -> int:
        return backends.workers(self.backend, _thread_count(None))

    def _native(self, x: ArrayOrTensor) -> Any:
        """`x` as the backend computes with it."""
        return backends.native(x, self.backend, self.float64)


def _empty(bundles: Sequence[Bundle]) -> Points:
    """Room for a number for every ray."""
    return np.empty((len(bundles), *bundles[0].shape)) if bundles else np.empty(0)


# An integral is length x mean. The mean moves with the planes of either grid, and, attenuated, with the length.


def _by_ends(piece: _Piece, values: Points, derivatives: Points, grid: Grid, mu_grid: Grid) -> Points:
    """The gradient (2, n, 3) by start and end of the rays of a piece."""
    along, lengths = _along(piece), _lengths(piece)
    weights = values * lengths
    result = np.empty((2, len(values), 3))
    for end in range(2):
        result[end] = (weights * derivatives[1 + 3 * end : 4 + 3 * end]).T @ _linear(grid)
        if len(derivatives) > 7:
            result[end] += (weights * derivatives[7 + 3 * end : 10 + 3 * end]).T @ _linear(mu_grid)
    by_length = (_by_length(values, lengths, derivatives) * along).T
    result[0] -= by_length
    result[1] += by_length
    return result


def _by_fan(piece: _Piece, values: Points, derivatives: Points, grid: Grid, mu_grid: Grid) -> Points:
    """The gradient (4, 3) by source, corner, line step and ray step of the fan of a piece."""
    assert isinstance(piece.bundle, Fan)
    numbers, lengths = _numbers(piece), _lengths(piece)
    # Not ray by ray: first sums over the rays, times their numbers where a step moves their ends as often.
    # Not `@`, of which BLAS would make threads of its own beside ours.
    by_planes = np.einsum("in,jn->ij", derivatives[1:13], values * lengths * numbers)
    by_start, by_end = by_planes[:3, 0] @ _linear(grid), by_planes[3:6].T @ _linear(grid)
    if len(derivatives) > 7:
        by_start += by_planes[6:9, 0] @ _linear(mu_grid)
        by_end += by_planes[9:].T @ _linear(mu_grid)
    weighted = _by_length(values, lengths, derivatives) * numbers
    by_length = np.einsum("in,jn->ij", weighted, numbers) @ _edges(piece.bundle)
    gradient = np.concatenate([by_start[None] - by_length[:1], by_end + by_length])
    return gradient[[0, 1, 3, 2]] if piece.transposed else gradient


def _by_length(values: Points, lengths: Points, derivatives: Points) -> Points:
    """The gradient (n,) by the rays' lengths at constant ends on the lattices, divided by the lengths."""
    by_length = derivatives[0] if len(derivatives) == 7 else derivatives[0] + lengths * derivatives[13]
    return values * by_length / np.where(lengths > 0, lengths, 1.0)


def _along(piece: _Piece) -> Points:
    """Source to target of the rays, (3, n), world mm."""
    if isinstance(piece.bundle, Fan):
        return np.einsum("ij,in->jn", _edges(piece.bundle), _numbers(piece))
    rays = piece.bundle[piece.lines]
    return (rays.ends - rays.starts).T


def _lengths(piece: _Piece) -> Points:
    return np.sqrt((_along(piece) ** 2).sum(axis=0))


def _edges(fan: Fan) -> Points:
    """Source to corner, line step and ray step, (3, 3): times the `_numbers` of a ray it is that from end to end."""
    return np.stack([fan.corner - fan.source, fan.line_step, fan.ray_step])


def _numbers(piece: _Piece) -> Points:
    """Of the rays of a fan: 1, number of the line, number of the ray in it, (3, n)."""
    n_lines, n_rays = piece.bundle.shape
    lines = range(n_lines)[piece.lines]
    numbers = np.ones((3, len(lines), n_rays))
    numbers[1], numbers[2] = np.arange(lines.start, lines.stop)[:, None], np.arange(n_rays)
    return numbers.reshape(3, -1)


def _linear(grid: Grid) -> Points:
    return grid.index_from_world[:3, :3]


def _tracer(
    volume: Volume | ArrayOrTensor,
    backend: str,
    grid: Grid | None,
    mu: Volume | ArrayOrTensor | None,
    mu_grid: Grid | None,
    geometry: tuple[Any, ...],
) -> tuple[ArrayOrTensor, ArrayOrTensor, Tracer]:
    """Checked numbers of the volume and of mu, both arrays or both tensors, and what traces rays of that `geometry`."""
    if isinstance(volume, Volume):  # nothing attenuates attenuation
        require_quantity(volume.quantity, LINE_INTEGRALS if mu is None else ("activity",), "line integrals")
    array, grid = _field(volume, "volume", grid, None, backend == "numpy")
    if mu is not None:
        if isinstance(mu, Volume):
            require_quantity(mu.quantity, ("mu",), "mu")
        mu, mu_grid = _field(mu, "mu", mu_grid, grid, backend == "numpy")
        array, mu = together(array, checked_mu(mu, mu_grid, backend == "numpy"))
    name = backends.choose(backend)
    if is_tensor(array) and array.device.type != "cpu" and backend == "auto":
        name = backends.for_tensor(array)
    float64 = name == "numpy" or any(is_double(value) for value in (array, mu, *geometry))
    return array, mu, Tracer(grid, name, mu_grid, float64)


def fans(vectors: Points, shape: tuple[int, int]) -> list[Fan]:
    """The fans of `vectors` (..., 4, 3)."""
    return [
        Fan(source, corner, line_step, ray_step, shape)
        for source, corner, line_step, ray_step in vectors.reshape(-1, 4, 3)
    ]


def fan_vectors(value: ArrayLike, name: str) -> Points:
    """`value` as an array (..., 4, 3) of real, finite numbers, or `InputError`."""
    shape = _shape(value)
    vectors = real_array(value, name, shape)
    if shape[-2:] != (4, 3):
        raise InputError(f"{name}: expected ... x 4 x 3, got shape {shape}")
    return vectors


def _field(
    value: Volume | ArrayOrTensor, name: str, grid: Grid | None, default: Grid | None, float64: bool
) -> tuple[ArrayOrTensor, Grid]:
    """The numbers of a `Volume`, or of an array or tensor on `grid`, or else on `default`; and their grid."""
    if isinstance(value, Volume):
        if grid is not None and grid != value.grid:
            raise InputError(f"{name} is a Volume and has a grid; leave the other out")
        return value.array, value.grid
    grid = grid or default
    if grid is None:
        raise InputError(f"{name}: expected a Volume, or also a grid, got {type(value).__name__}")
    if not isinstance(grid, Grid):
        raise InputError(f"{name}: expected its grid to be Grid, got {type(grid).__name__}")
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


def _shape(value: ArrayLike) -> tuple[int, ...]:
    """The shape of `value`; () of what `real_array` refuses: what is ragged, or tensors of a graph in a list."""
    try:
        return np.shape(value)
    except (ValueError, RuntimeError):
        return ()


def points(value: ArrayLike, name: str) -> Points:
    """`value`, one point (3,) or many (n, 3), as an array (n, 3), or `InputError`."""
    shape = _shape(value)
    if shape == (0,):  # an empty list
        return np.empty((0, 3))
    return real_array(value, name, (3,))[None] if len(shape) == 1 else real_array(value, name, (None, 3))
