"""The projector as a linear operator: what is the same for every backend."""

from __future__ import annotations

import copy
import functools
import math
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, alike, checked, cropped, is_double, is_tensor, like, together, zeros
from ..errors import InputError, InputWarning
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import available, require
from ..progress import Progress
from ..volumes.volume import Volume
from . import backends
from .models import Array, Beam, Model, Transmission, require_model
from .rays import Attenuation, IndexFans, RayMapper, window

# Rays handed to a backend at once: enough that a call costs nothing, few enough that their arrays stay in the cache. A GPU
# wants more (torch cuts them into chunks by itself), and a torch on a CPU has threads of its own.
_FEWEST_RAYS = 4096
_MOST_RAYS = {"cpu": 2**14, "torch": 2**18, "cuda": 2**22}

# Rays of what the threads of the adjoint do before they wait for each other.
_RAYS_OF_A_ROUND = 2**19

# Rays of a pixel that are kept from call to call: few images are done before their rays would be made.
_BEAMS_KEPT = 16

# Threads of the adjoint, each with a volume of its own: more would gain little and take much memory.
_MOST_VOLUMES = 8

ParallelMap = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]

# Adds values to a volume along rays, with what attenuates them: a backend's adjoint, for instance.
Spread = Callable[[ArrayOrTensor, ArrayOrTensor, Any, Any], None]


class LinearOperator(ABC):
    """``A(x)``, with the exact adjoint ``A.T(y)``; differentiable in torch."""

    def __call__(self, x: Volume | ArrayOrTensor, progress: Progress | None = None) -> ArrayOrTensor:
        """Apply the operator.

        Parameters
        ----------
        x
            Numpy array or torch tensor (a projector also takes a `Volume`).
        progress
            Called as ``progress(views done, views)``; what it raises stops the work.

        Returns
        -------
        array or tensor
            A tensor on the device of `x` if that is a tensor (part of torch's graph if it requires a
            gradient, for every backend), else a numpy array.

        Raises
        ------
        InputError
            Another shape or grid, not real numbers, not finite, or more memory needed than there is.
        """
        x = self._check(x)
        if is_tensor(x):
            from .autograd import apply

            return apply(self, x, progress)
        return self._run(x, progress)

    @property
    @abstractmethod
    def T(self) -> LinearOperator:
        """The exact adjoint, <A x, y> = <x, A.T y>."""

    @abstractmethod
    def _check(self, x: Any) -> ArrayOrTensor: ...

    @abstractmethod
    def _run(self, x: ArrayOrTensor, progress: Progress | None = None) -> ArrayOrTensor:
        """Apply to an array or tensor of the right shape, without checks and without recording a graph."""


class Projector(LinearOperator):
    """Images of a volume, and the adjoint.

    Parameters
    ----------
    grid : Grid
        The voxels. Values outside are 0.
    views : Views
        The M images: rays from each source to the centres of the pixels.
    model : Transmission or Emission
        What a pixel measures; by default the line integral.
    backend : str
        ``"numpy"`` (the float64 reference), ``"torch"`` (on the device of a tensor), ``"cpu"`` (compiled, on the
        processor), ``"cuda"`` (NVIDIA GPUs; ``pip install warp-lang``), or ``"auto"``: cpu where there are kernels for the
        platform, else torch, else numpy; for a tensor on a GPU cuda if it works there, else torch. Arrays go to a GPU only
        when asked.
    threads : int, optional
        Threads of cpu and numpy, by default one per core (torch has a setting of its own, cuda needs none). The images do
        not depend on it; the adjoint does by float32 rounding, and is the same every time for a given number.
        The adjoint takes a volume per thread, so it uses at most 8, and fewer when memory is short.

    Raises
    ------
    InputError
        An argument is of another kind, no such backend, or its library is missing.

    Notes
    -----
    The integral along a ray is exact for the piecewise constant volume (Siddon 1985), from source to target.
    The results are float32; float64 for ``backend="numpy"``, and for tensors of float64 with all backends but cuda.
    On a GPU the adjoint of the torch and cuda backends adds in no fixed order: it differs by float32 rounding from
    call to call.

    Examples
    --------
    >>> grid = Grid.centered((64, 64, 64), spacing=1.0)
    >>> views = Views([[0, 0, -100]], [[0, 0, 100]], [[2, 0, 0]], [[0, 2, 0]], shape=(64, 64))
    >>> A = Projector(grid, views)
    >>> images = A(np.ones(grid.shape))
    >>> images.shape
    (1, 64, 64)
    >>> A.T(images).shape
    (64, 64, 64)
    """

    def __init__(
        self,
        grid: Grid,
        views: Views,
        model: Model | None = None,
        backend: str = "auto",
        threads: int | None = None,
    ) -> None:
        for value, kind, name in ((grid, Grid, "grid"), (views, Views, "views")):
            if not isinstance(value, kind):
                raise InputError(f"projector: expected {name} to be {kind.__name__}, got {type(value).__name__}")
        self.grid = grid
        self.views = views
        self.model: Model = Transmission() if model is None else require_model(model)
        self.model.check(views)
        if caution := self.model.caution(views, grid):
            warnings.warn(caution, InputWarning, stacklevel=2)
        self.backend = backends.choose(backend)
        self.threads = _thread_count(threads)
        self._auto = backend == "auto"
        self._kept_beams: dict[int, tuple[list[Beam], bool]] = {}
        self._mu: ArrayOrTensor = None if self.model.mu is None else self.model.mu.array
        self._adjoint = AdjointProjector(self)

    def __call__(
        self, x: Volume | ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor | None = None
    ) -> ArrayOrTensor:
        """The images of a volume.

        Parameters
        ----------
        x, progress
            As of `LinearOperator`; `x` may also be a `Volume`.
        mu
            Attenuation coefficients, 1/mm, in place of the model's: an array or tensor on the grid of its `mu`.

        Returns
        -------
        array or tensor
            As of `LinearOperator`, and a tensor also if `mu` is one: part of torch's graph if `x` or `mu` requires a
            gradient, for every backend. Where `mu` requires one, gradients of gradients are refused.

        Raises
        ------
        InputError
            As of `LinearOperator`; and the model has no mu, or `mu` has another shape, or is negative.
        """
        if mu is None:
            return super().__call__(x, progress)
        x, mu = together(self._check(x), self._check_mu(mu))
        attenuated = copy.copy(self)
        attenuated._mu = mu
        attenuated._adjoint = AdjointProjector(attenuated)
        if is_tensor(x):
            from .autograd import apply_attenuated

            return apply_attenuated(attenuated, x, mu, progress)
        return attenuated._run(x, progress)

    @property
    def shape_in(self) -> tuple[int, int, int]:
        """Shape of a volume, (n_x, n_y, n_z)."""
        return self.grid.shape

    @property
    def shape_out(self) -> tuple[int, int, int]:
        """Shape of the images, (M, n_v, n_u)."""
        return (len(self.views), *self.views.shape)

    @property
    def T(self) -> AdjointProjector:
        """The exact adjoint: images (M, n_v, n_u) to an array of ``grid.shape``."""
        return self._adjoint

    def iter_views(self, volume: Volume | ArrayOrTensor) -> Iterator[ArrayOrTensor]:
        """The images one by one, each (n_v, n_u): work between which a job can stop. Gradients are not recorded.

        Leave the volume as it is until the last: images are made ahead of need.
        """
        volume = self._check(volume)
        return (like(image, volume) for image in self._images(volume))

    def __repr__(self) -> str:
        n_v, n_u = self.views.shape
        return f"Projector({_times(self.grid.shape)} voxels, {len(self.views)} views of {n_v} x {n_u}, {self.backend})"

    def _check(self, x: Volume | ArrayOrTensor) -> ArrayOrTensor:
        if isinstance(x, Volume):
            if not _same(x.grid, self.grid):
                raise InputError(
                    f"volume: its grid ({_describe(x.grid)}) is not the projector's ({_describe(self.grid)})"
                )
            self.model.check_volume(x)
            return x.array
        return checked(x, "volume", self.shape_in, self._float64)

    def _check_mu(self, mu: ArrayOrTensor) -> ArrayOrTensor:
        if self.model.mu is None:
            raise InputError("mu: the projector's model has none; give it one to say on which grid mu is")
        return checked_mu(mu, self.model.mu.grid, self._float64)

    def _run(self, x: ArrayOrTensor, progress: Progress | None = None) -> ArrayOrTensor:
        n_views, n_v, n_u = self.shape_out
        wide = 8 if self._float64 or is_double(x) else 4
        what = f"projecting {_times(self.shape_in)} voxels into {n_views} images of {n_v} x {n_u} pixels"
        require(wide * (n_views * n_v * n_u + self.grid.n_voxels) + self._extra_bytes(wide), what)
        images = None
        _report(progress, 0, n_views)
        for m, image in enumerate(self._images(x)):
            images = zeros(self.shape_out, image) if images is None else images
            images[m] = image
            _report(progress, m + 1, n_views)
        if images is None:
            images = np.zeros(self.shape_out, np.float64 if self._float64 else np.float32)
        return like(images, x)

    def _images(self, x: ArrayOrTensor) -> Iterator[ArrayOrTensor]:
        """Images of a checked volume, native to the backend."""
        _require_rays(self.views)
        name = self._backend_for(x)
        integrate = backends.load(name).forward
        native = self._native(x, name)
        box, trace = self._lattices(native, native)
        workers, groups = self._workers(name), self._groups(name)
        with _parallel(workers) as parallel_map:
            if groups:
                images_of = functools.partial(self._images_together, box=box, trace=trace, integrate=integrate)
                for first in range(0, len(groups), 4 * workers):  # some at a time, whose images are held at once
                    for of_group in parallel_map(images_of, groups[first : first + 4 * workers]):
                        yield from (self._finished(image, x) for image in of_group)
                return
            # The next view is begun before one is done, so that no thread waits for the others at a view's end.
            before: tuple[int, ArrayOrTensor, Iterable[None]] | None = None
            for m in range(len(self.views)):
                image, weighted = zeros(self.views.shape, box), self._weighted(box, m, trace.origin)
                beams, by_columns = self._beams(m)
                lines, rays = window([beam.rays for beam in beams], _corners(self.grid, box, trace.origin))

                def project(
                    block: slice,
                    beams: list[Beam] = beams,
                    rays: slice = rays,
                    lines: ArrayOrTensor = image.T if by_columns else image,
                    weighted: ArrayOrTensor = weighted,
                ) -> None:
                    pixels = lines[block, rays]
                    for beam, shifts in _bundles(beams, pixels.shape, name):
                        fan, weights = beam.part(block, rays, shifts)
                        integrals = integrate(weighted, *trace(fan)).reshape(-1, *pixels.shape)
                        weighed = integrals if weights is None else alike(weights, box) * integrals
                        pixels += weighed[0] if len(weighed) == 1 else weighed.sum(0)

                running = iter(parallel_map(project, _blocks(lines, rays, name, workers)))
                if before is not None:
                    yield self._completed(*before, x)
                before = m, image, running
            if before is not None:
                yield self._completed(*before, x)

    def _completed(self, m: int, image: ArrayOrTensor, running: Iterable[None], x: ArrayOrTensor) -> ArrayOrTensor:
        """View m's image, once what adds to it has run."""
        _wait_for(running)
        return self._finished(self._responded(image, m), x)

    def _images_together(
        self, views: range, box: ArrayOrTensor, trace: RayMapper, integrate: Callable[..., ArrayOrTensor]
    ) -> list[ArrayOrTensor]:
        """The images of several views at once."""
        images = zeros((len(views), *self.views.shape), box)
        for which, by_columns, weights, rays, attenuation in self._rays_together(views, trace):
            lines = images.swapaxes(1, 2) if by_columns else images
            integrals = integrate(box, rays, attenuation).reshape(-1, *lines.shape[1:])
            if weights is not None:
                integrals = alike(weights, box) * integrals
            if len(set(which)) == len(which):
                lines[which] = alike(integrals, images)
            else:
                for k, integral in zip(which, integrals, strict=True):
                    lines[k] += integral
        return [self._responded(image, m) for image, m in zip(images, views, strict=True)]

    def _responded(self, image: ArrayOrTensor, m: int) -> ArrayOrTensor:
        """View m's image with the detector's response."""
        response = self.model.response(self.views, m)
        if response is None:
            return image
        along_v, along_u = (alike(matrix, image) for matrix in response)
        return along_v @ image @ along_u.T

    def _groups(self, backend: str) -> list[range]:
        """The views, several at a time where all rays of these are not too many for a backend; else none."""
        n_views = len(self.views)
        if not n_views or self.model.weights_voxels:  # then every view is of a volume of its own
            return []
        rays = self._rays_of_a_view
        most = _MOST_RAYS.get(backend, _FEWEST_RAYS)
        if backend == "torch":  # slow enough: work between which a job can stop stays short
            most = _FEWEST_RAYS
        at_once = min(most // rays, max(_FEWEST_RAYS // rays, n_views // (2 * self._workers(backend))))
        return [range(m, min(m + at_once, n_views)) for m in range(0, n_views, at_once)] if at_once > 1 else []

    @property
    def _rays_of_a_view(self) -> int:
        """How many there are, about: those of the first."""
        return math.prod(self.views.shape) * sum(len(beam.rays.shifts) for beam in self._beams(0)[0])

    def _rays_together(
        self, views: range, trace: RayMapper
    ) -> Iterator[tuple[list[int], bool, Array | None, IndexFans, Attenuation | None]]:
        """All rays of several views: those whose lines are the images' rows, and those whose lines are their columns.

        Yields of which of `views` each fan is, whether lines are columns, weights (fans, lines, rays), None where all are 1,
        rays and attenuation.
        """
        of_views = [self._beams(m) for m in views]
        for by_columns in (False, True):
            beams = [(k, beam) for k, (own, columns) in enumerate(of_views) if columns == by_columns for beam in own]
            if not beams:
                continue
            which = [k for k, beam in beams for _ in beam.rays.shifts]
            weights = None
            if any(beam.weigh for _, beam in beams):
                weights = np.concatenate([beam.weights() for _, beam in beams])
            yield which, by_columns, weights, *trace(*(beam.rays for _, beam in beams))

    def _weighted(self, box: ArrayOrTensor, m: int, origin: tuple[int, int, int] = (0, 0, 0)) -> ArrayOrTensor:
        """A part of a volume, from voxel `origin` on, times view m's voxel weights."""
        if not self.model.weights_voxels:
            return box
        part = tuple(slice(first, first + n) for first, n in zip(origin, box.shape, strict=True))
        return box * alike(self.model.voxel_weights(self.views, m, self.grid)[part], box)

    def _extra_bytes(self, wide: int) -> int:
        """Bytes of a copy of mu, and of voxel weights with what they weight."""
        mu = 0 if self.model.mu is None else self.model.mu.grid.n_voxels
        return wide * mu + (2 * wide + 8) * self.grid.n_voxels * self.model.weights_voxels

    def _beams(self, m: int) -> tuple[list[Beam], bool]:
        """View m's rays, and whether their lines are the image's columns, not its rows.

        Neighbours in a line are neighbours in memory: lines follow the volume's contiguous axis as well as they can.
        """
        if m in self._kept_beams:
            return self._kept_beams[m]
        beams = list(self.model.beams(self.views, m, self.grid))
        by_columns = beams[0].rays.lies_across(self.grid)
        if by_columns:
            beams = [beam.transposed() for beam in beams]
        if sum(len(beam.rays.shifts) for beam in beams) <= _BEAMS_KEPT:
            self._kept_beams[m] = beams, by_columns
        return beams, by_columns

    def _lattices(
        self, native: ArrayOrTensor, volume: ArrayOrTensor = None, whole_mu: bool = False
    ) -> tuple[ArrayOrTensor, RayMapper]:
        """`lattices` of this projector; `native` is an array of the kind with which the backend computes."""
        if self.model.mu is None:
            return lattices(self.grid, volume)
        return lattices(self.grid, volume, alike(self._mu, native), self.model.mu.grid, whole_mu)

    def _native(self, x: ArrayOrTensor, name: str) -> ArrayOrTensor:
        """`x` as the backend `name` computes with it."""
        return backends.native(x, name, name == "numpy" or is_double(x))

    def _backend_for(self, x: ArrayOrTensor) -> str:
        return backends.for_tensor(x) if self._auto and is_tensor(x) and x.device.type != "cpu" else self.backend

    def _workers(self, name: str) -> int:
        return backends.workers(name, self.threads)

    def _finished(self, result: ArrayOrTensor, x: ArrayOrTensor) -> ArrayOrTensor:
        """`result` of float32, unless it is to be of float64 (where "auto" falls back to numpy it is not)."""
        if self._float64 or is_tensor(result) or is_double(x):
            return result
        return result.astype(np.float32, copy=False)

    @property
    def _float64(self) -> bool:
        return self.backend == "numpy" and not self._auto


class AdjointProjector(LinearOperator):
    """The adjoint of a projector, ``A.T``: spreads images back along their rays, with the weights of ``A``."""

    def __init__(self, projector: Projector) -> None:
        self._projector = projector

    @property
    def T(self) -> Projector:
        """The projector."""
        return self._projector

    @property
    def shape_in(self) -> tuple[int, int, int]:
        """Shape of the images, (M, n_v, n_u)."""
        return self._projector.shape_out

    @property
    def shape_out(self) -> tuple[int, int, int]:
        """Shape of a volume, (n_x, n_y, n_z)."""
        return self._projector.shape_in

    def __repr__(self) -> str:
        return f"{self._projector!r}.T"

    def _check(self, x: ArrayOrTensor) -> ArrayOrTensor:
        return checked(x, "images", self.shape_in, self._projector._float64)

    def _run(self, x: ArrayOrTensor, progress: Progress | None = None) -> ArrayOrTensor:
        A = self._projector
        name = A._backend_for(x)
        images = A._native(x, name)
        _, trace = A._lattices(images)
        spread = backends.load(name).adjoint
        volume = self._spread(images, name, trace, A.grid, lambda m: spread, A.model.weights_voxels, progress)
        return like(A._finished(volume, x), x)

    def _mu_gradient(self, images: ArrayOrTensor, volume: ArrayOrTensor) -> ArrayOrTensor:
        """The gradient of <A volume, images> by mu, on mu's whole grid."""
        A = self._projector
        assert A.model.mu is not None
        name = A._backend_for(volume)
        native = A._native(volume, name)
        box, trace = A._lattices(native, native, whole_mu=True)
        add_gradient = backends.load(name).mu_gradient

        def of_view(m: int) -> Spread:
            seen = A._weighted(box, m, trace.origin)
            return lambda gradient, values, rays, attenuation: add_gradient(gradient, seen, values, rays, attenuation)

        gradient = self._spread(A._native(images, name), name, trace, A.model.mu.grid, of_view)
        return like(A._finished(gradient, images), images)

    def _spread(
        self,
        images: ArrayOrTensor,
        name: str,
        trace: RayMapper,
        grid: Grid,
        of_view: Callable[[int], Spread],
        weighted: bool = False,
        progress: Progress | None = None,
    ) -> ArrayOrTensor:
        """What the functions ``of_view(m)`` add for all rays of native images to a volume on `grid`.

        With `weighted` each view's volume is multiplied by its voxel weights.
        """
        A = self._projector
        volume_bytes, extra_bytes = images.itemsize * grid.n_voxels, A._extra_bytes(images.itemsize)
        require(volume_bytes + extra_bytes, f"the adjoint into {_times(grid.shape)} voxels")
        _require_rays(A.views)
        workers = volume_workers(A._workers(name), volume_bytes, extra_bytes)
        n_views, groups = len(A.views), A._groups(name)
        if not n_views:
            return zeros(grid.shape, images)
        # Between rounds the threads wait for each other: seldom, but often enough to tell how far the work is.
        views_of_round = 1 if weighted else max(1, _RAYS_OF_A_ROUND // A._rays_of_a_view)
        of_round = max(workers, views_of_round // len(groups[0])) if groups else views_of_round
        groups = groups or [range(m, m + 1) for m in range(n_views)]
        _report(progress, 0, n_views)
        with _parallel(workers) as parallel_map:
            volumes = list(parallel_map(lambda _: zeros(grid.shape, images), range(workers)))
            total: ArrayOrTensor = zeros(grid.shape, images) if weighted else None
            for first in range(0, len(groups), of_round):
                # Always the same parts into the same volume, so that the sums' order, and so the result, is always the same.
                some = groups[first : first + of_round]
                parts = [part for views in some for part in self._parts(images, views, name, workers, of_view, trace)]

                def add(worker: int, parts: list[Callable[[ArrayOrTensor], None]] = parts) -> None:
                    for part in parts[worker::workers]:
                        part(volumes[worker])

                _wait_for(parallel_map(add, range(workers)))
                if weighted:  # each view joins the others weighted
                    total += A._weighted(_sum(volumes, parallel_map), some[0].start)
                    for volume in volumes:
                        volume[:] = 0
                for done in range(some[0].start, some[-1].stop):
                    _report(progress, done + 1, n_views)
            return total if weighted else _sum(volumes, parallel_map)

    def _parts(
        self,
        images: ArrayOrTensor,
        views: range,
        name: str,
        workers: int,
        of_view: Callable[[int], Spread],
        trace: RayMapper,
    ) -> list[Callable[[ArrayOrTensor], None]]:
        """What there is to be added to volumes from the images of `views`, as much at once as a backend is given."""
        A, m = self._projector, views.start
        if len(views) > 1:
            return [functools.partial(self._spread_together, images, views, of_view(m), trace)]
        image, spread = images[m], of_view(m)
        response = A.model.response(A.views, m)
        if response is not None:
            along_v, along_u = (alike(matrix, image) for matrix in response)
            image = along_v.T @ image @ along_u
        beams, by_columns = A._beams(m)
        lines = image.T if by_columns else image
        blocks, rays = window([beam.rays for beam in beams], A.grid.corners())

        def add(block: slice, beam: Beam, shifts: slice, volume: ArrayOrTensor) -> None:
            fan, weights = beam.part(block, rays, shifts)
            pixels = lines[block, rays]
            values = alike(np.ones(1) if weights is None else weights, pixels) * pixels
            spread(volume, values.reshape(-1), *trace(fan))

        return [
            functools.partial(add, block, *bundle)
            for block in _blocks(blocks, rays, name, workers)
            for bundle in _bundles(beams, (block.stop - block.start, rays.stop - rays.start), name, workers)
        ]

    def _spread_together(
        self, images: ArrayOrTensor, views: range, spread: Spread, trace: RayMapper, volume: ArrayOrTensor
    ) -> None:
        """`_spread` of several views at once."""
        A = self._projector
        some = images[views.start : views.stop]
        responses = [A.model.response(A.views, m) for m in views]
        if responses[0] is not None:
            along_v, along_u = (alike(np.stack(matrices), images) for matrices in zip(*responses, strict=True))
            some = along_v.swapaxes(1, 2) @ some @ along_u
        for which, by_columns, weights, rays, attenuation in A._rays_together(views, trace):
            values = (some.swapaxes(1, 2) if by_columns else some)[which]
            if weights is not None:
                values = alike(weights, images) * values
            spread(volume, values.reshape(-1), rays, attenuation)


def lattices(
    grid: Grid,
    volume: ArrayOrTensor,
    mu: ArrayOrTensor = None,
    mu_grid: Grid | None = None,
    whole_mu: bool = False,
) -> tuple[ArrayOrTensor, RayMapper]:
    """The part of `volume` that is not empty, and what brings rays into the index spaces of that and of mu.

    Empty margins cost time: most objects fill a small part of their grid. With None (a volume yet to be filled)
    the rays are for the whole grid. What attenuates is kept wherever it is, outside the volume's filled part too;
    and where nothing does, with `whole_mu`.
    """
    box, origin, mu_origin = volume, (0, 0, 0), (0, 0, 0)
    if volume is not None:
        (box,), origin = cropped(volume)
    if mu is None:
        return box, RayMapper(grid, origin)
    if mu_grid is None or _same(mu_grid, grid):
        if volume is None or whole_mu:
            return volume, RayMapper(grid, mu=mu)
        (common, mu_common), common_origin = cropped(volume, mu)
        # One lattice is walked twice as fast as two, but two boxes let rays that miss the volume's go at once.
        if math.prod(common.shape) <= 2 * math.prod(box.shape):
            return common, RayMapper(grid, common_origin, mu_common)
    if not whole_mu:
        (mu,), mu_origin = cropped(mu)
    return box, RayMapper(grid, origin, mu, mu_grid or grid, mu_origin)


def volume_workers(workers: int, volume_bytes: int, extra_bytes: int = 0) -> int:
    """As many of `workers` as may have a volume each: fewer threads rather than no room for anything else."""
    return min(workers, _MOST_VOLUMES, max(1, (available() - extra_bytes) // (2 * volume_bytes)))


def _sum(volumes: list[ArrayOrTensor], parallel_map: ParallelMap) -> ArrayOrTensor:
    """Their sum, in the first of them."""
    total, *others = (volume.reshape(-1) for volume in volumes)
    size = -(-len(total) // len(volumes))

    def add(first: int) -> None:
        for other in others:
            total[first : first + size] += other[first : first + size]

    _wait_for(parallel_map(add, range(0, len(total), size) if others else []))
    return volumes[0]


def _blocks(lines: slice, rays: slice, backend: str, workers: int) -> list[slice]:
    """The lines, cut into what a backend is given at once: two pieces or more for each worker."""
    n_lines, line_length = lines.stop - lines.start, rays.stop - rays.start
    if not n_lines or not line_length:
        return []
    most = _MOST_RAYS.get(backend, _FEWEST_RAYS)
    rays_at_once = max(min(_FEWEST_RAYS, most), min(most, n_lines * line_length // (2 * workers)))
    size = max(1, rays_at_once // line_length)
    return [slice(first, min(first + size, lines.stop)) for first in range(lines.start, lines.stop, size)]


def _bundles(beams: list[Beam], shape: tuple[int, int], backend: str, workers: int = 1) -> Iterator[tuple[Beam, slice]]:
    """The beams, and as many of their shifts at once as a backend is given of so many lines and rays each.

    Where there are shifts enough, in a piece or more for each worker.
    """
    for beam in beams:
        n = len(beam.rays.shifts)
        at_once = max(1, min(_MOST_RAYS.get(backend, _FEWEST_RAYS) // math.prod(shape), math.ceil(n / workers)))
        yield from ((beam, slice(first, min(first + at_once, n))) for first in range(0, n, at_once))


def _corners(grid: Grid, box: ArrayOrTensor, origin: tuple[int, int, int]) -> Array:
    """Corners (8, 3), world mm, of the part of `grid` that is `box`, an array that begins at voxel `origin`."""
    affine = grid.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ np.array(origin)
    return Grid(box.shape, affine).corners()


@contextmanager
def _parallel(workers: int) -> Iterator[ParallelMap]:
    """A map that runs on `workers` threads; nothing of it runs on when the context is left."""
    if workers == 1:
        yield map
        return
    tasks: list[Future[Any]] = []

    def parallel_map(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
        started = [_pool(workers).submit(function, item) for item in items]
        tasks[:] = [task for task in tasks if not task.done()] + started
        return (task.result() for task in started)

    try:
        yield parallel_map
    finally:
        for task in tasks:
            task.cancel()
        wait(tasks)


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """Threads that stay: starting some for every call would cost a short one more than its work."""
    return ThreadPoolExecutor(workers, thread_name_prefix="mphdrr")


if hasattr(os, "register_at_fork"):  # threads stay behind when a process forks, as data loaders do
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _wait_for(running: Iterable[None]) -> None:
    for _ in running:
        pass


def _require_rays(views: Views) -> None:
    n_v, n_u = views.shape
    # An image of float32, and some arrays of float64 from which the weights of its rays are made.
    require(110 * n_v * n_u, f"an image of {n_v} x {n_u} pixels, with its rays,")


def checked_mu(mu: ArrayOrTensor, grid: Grid, float64: bool) -> ArrayOrTensor:
    """`mu` as `checked` numbers on `grid`, none of them negative."""
    mu = checked(mu, "mu", grid.shape, float64)
    if mu.min() < 0:
        raise InputError(f"mu: expected no negative coefficient, got {float(mu.min()):g} 1/mm")
    return mu


def _thread_count(threads: int | None) -> int:
    if threads is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if isinstance(threads, bool) or not isinstance(threads, int | np.integer) or threads < 1:
        raise InputError(f"threads: expected a whole number of at least 1, got {threads!r}")
    return int(threads)


def _report(progress: Progress | None, done: int, total: int) -> None:
    if progress is not None:
        progress(done, total)


def _same(a: Grid, b: Grid) -> bool:
    """Whether two grids are the same lattice, to the rounding of a file's float32 affine."""
    return a.shape == b.shape and np.allclose(a.corners(), b.corners(), rtol=0, atol=1e-4 * float(b.spacing.min()))


def _describe(grid: Grid) -> str:
    return f"{_times(grid.shape)} voxels of {_times(tuple(f'{s:.6g}' for s in grid.spacing))} mm"


def _times(numbers: tuple[Any, ...]) -> str:
    return " x ".join(map(str, numbers))
