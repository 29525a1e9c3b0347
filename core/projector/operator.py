"""The projector as a linear operator."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, ArrayOrTensor, cast_like, checked, is_double, is_tensor, promote, to_caller, to_numpy, zeros
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import Requirements
from ..progress import Progress, part_of, tell
from ..recording import recorded_warnings
from ..validation import freeze, shape_text
from ..volumes.images import Images
from ..volumes.volume import AIR_HU, CONVERT, Volume
from . import backends
from .bundles import Bundle, Bundles
from .doubts import doubts
from .execution import Execution
from .lattices import require_no_negative, same_lattice
from .linear_operator import LinearOperator
from .models import Model, Transmission, each_pixel
from .parallel import thread_count
from .subsets import balanced_subsets
from .transmittance import Field

_PADDING = (-2000.0, -2048.0, -3024.0)  # what CT scanners write outside of what they scanned


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
    double : bool
        Whether to compute in float64, whatever it is given; not with cuda.

    Raises
    ------
    InputError
        There is no such backend, or its library is missing.

    Notes
    -----
    The integral along a ray is exact for the piecewise constant volume (Siddon 1985), from source to target.
    The results are float32; float64 with `double` or ``backend="numpy"``, and for tensors of float64 with all backends but
    cuda.
    On a GPU the adjoint of the torch and cuda backends adds in no fixed order: it differs by float32 rounding from
    call to call. Up to 128 MiB of rays and their weights are kept from call to call, of lines apart for each line.

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

    _names = ("volume", "images")

    def __init__(
        self,
        grid: Grid,
        views: Views,
        model: Model | None = None,
        backend: str = "auto",
        threads: int | None = None,
        double: bool = False,
    ) -> None:
        model = Transmission() if model is None else model
        for value, kind, what in (
            (grid, Grid, "grid to be Grid"),
            (views, Views, "views to be Views"),
            (model, Model, "model to be Transmission, Emission or another model"),
        ):
            if not isinstance(value, kind):
                raise InputError(f"projector: expected {what}, got {type(value).__name__}")
        self.grid, self.views = grid, views
        self._require = Requirements()
        self._auto = backend == "auto"
        self._backend = backends.choose(backend)
        self._float64 = double or (self._backend.always_float64 and not self._auto)
        self._settings: dict[str, Any] = {"backend": backend, "threads": threads, "double": double}
        if self._backend.name == "cuda":
            if double:
                advice = "leave double out, or take another backend"
                raise InputError(f"projector: backend cuda computes in float32 alone: {advice}")
            model = model.by_rays()
        self.model = model
        model.check(views)
        for doubt in doubts(grid, views, model):
            warn(doubt, 2)
        self.threads = thread_count(threads)
        self.which = freeze(np.arange(len(views)))
        self._bundles = Bundles(len(views), self._bundle)
        parts = model.parts()
        with recorded_warnings():  # this projector has given them
            self._parts = [Projector(grid, views, part, **self._settings) for part in parts if part is not model]
        self._depths = None if self._parts else model.by_depth(views, grid)

    def __call__(
        self, x: Volume | ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None
    ) -> ArrayOrTensor:
        """The images of a volume.

        Parameters
        ----------
        x, progress
            The same as for any `LinearOperator`; `x` may also be a `Volume`.
        mu
            Attenuation coefficients, 1/mm, in place of the model's: an array or tensor on the grid of its `mu`, one for a
            whole batch.

        Returns
        -------
        array or tensor
            A tensor if `x` or `mu` is one, else a numpy array: part of torch's graph if `x` or `mu` requires a
            gradient, for every backend. Where `mu` requires one, gradients of gradients are refused.

        Raises
        ------
        InputError
            The model has no mu, or `mu` has another shape, or is negative; or more memory is needed than there is.
        """
        if mu is None:
            images = super().__call__(x, progress)
            is_labelled = isinstance(x, Volume) and self.model.takes != ("activity",)
            return Images.tag(images, x.quantity) if is_labelled else images
        x = self._check(x)
        if self.model.mu is None:
            raise InputError("mu: the projector's model has none; give it one to say on which grid mu is")
        if any(part.model.mu is not self.model.mu for part in self._parts):
            advice = "give the model one volume of mu for all of them"
            raise InputError(f"mu: each of the model's lines has its own; {advice}")
        x, mu = promote(x, require_no_negative(checked(mu, "mu", self.model.mu.grid.shape, self._float64)))
        if not getattr(mu, "requires_grad", False):
            return self._apply(x, progress, mu)
        from . import autograd

        def run(needs: Any) -> Any:
            def gradients(images: ArrayOrTensor, needs: Any) -> Any:
                by_x, by_mu = needs
                return self.T._run(images, mu=mu) if by_x else None, self._mu_gradient(images, x, mu) if by_mu else None

            return self._run(x.detach(), progress, mu.detach()), gradients

        return autograd.step(run, x, mu)

    @property
    def backend(self) -> str:
        """The backend's name; "auto" stands for one of them."""
        return self._backend.name

    @property
    def shape_in(self) -> tuple[int, int, int]:
        """Shape of a volume, (n_x, n_y, n_z)."""
        return self.grid.shape

    @property
    def shape_out(self) -> tuple[int, int, int]:
        """Shape of the images, (M, n_v, n_u)."""
        return (len(self.views), *self.views.shape)

    @property
    def background(self) -> Array:
        """What the model expects besides the volume's images, (M, n_v, n_u), read-only: ``A(x) + A.background``.

        Dead pixels have none.
        """
        values = each_pixel(self.model.background)
        return freeze(np.where(self.living, values, 0.0)) if values.any() else np.broadcast_to(values, self.shape_out)

    @property
    def living(self) -> NDArray[np.bool_]:
        """Which pixels are not dead, (M, n_v, n_u), read-only: those whose efficiency in the model is not 0."""
        return np.broadcast_to(each_pixel(self.model.efficiency) > 0, self.shape_out)

    def iter_views(self, volume: Volume | ArrayOrTensor) -> Iterator[ArrayOrTensor]:
        """The images one by one, each (n_v, n_u): work between which a job can stop. Gradients are not recorded.

        Leave the volume as it is until the last: images are made ahead of need.
        """
        volume = self._check(volume, batch=False)
        return (to_caller(image, volume) for image in self._images(volume))

    def subsets(self, n: int) -> list[Projector]:
        """`n` projectors of parts of the views, balanced over rings and angles, their sizes differing by one at most.

        Each one's `which` says which views it has. Raises InputError where `n` is not from 1 to their number.
        """
        parts: list[Projector] = []
        with recorded_warnings():  # this projector has given them
            for which in balanced_subsets(self.views, n):
                own = self.grid, self.views[which], self.model.of_views(which)
                parts.append(copy.copy(self) if n == 1 else Projector(*own, **self._settings))
                parts[-1].which = freeze(which)
        return parts

    def __repr__(self) -> str:
        voxels, pixels = shape_text(self.grid.shape), shape_text(self.views.shape)
        return f"Projector({voxels} voxels, {len(self.views)} views of {pixels}, {self.backend})"

    def _check(self, x: Volume | ArrayOrTensor, batch: bool = True) -> ArrayOrTensor:
        if isinstance(x, Volume):
            if not same_lattice(x.grid, self.grid):
                its, wanted = map(_describe, (x.grid, self.grid))
                raise InputError(f"volume: its grid ({its}) is not the projector's ({wanted})")
            self.model.check_volume(x)
        array = x.array if isinstance(x, Volume) else checked(x, "volume", self.shape_in, self._float64, batch)
        # A thousand voxels or so: to look at all would take as long as an image.
        few: Any = (..., *(slice(n // 20, None, 1 + n // 10) for n in self.shape_in))
        some = to_numpy(array[few], np.float32)
        air = np.isin(some, _PADDING) | (abs(some - AIR_HU) < 50)
        if np.count_nonzero(air) > 0.05 * air.size:
            warn(f"volume: {np.mean(air):.0%} of its values are those of air in CT numbers{CONVERT}", 4)
        return array

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        n_views, n_v, n_u = self.shape_out
        itemsize = 8 if self._float64 or is_double(x) else 4
        what = f"projecting {shape_text(self.shape_in)} voxels into {n_views} images of {n_v} x {n_u} pixels"
        self._require(itemsize * (n_views * n_v * n_u + self.grid.n_voxels) + self._extra_bytes(itemsize), what)
        images = None
        tell(progress, 0, n_views)
        for m, image in enumerate(self._images(x, mu)):
            images = zeros(self.shape_out, image) if images is None else images
            images[m] = image
            tell(progress, m + 1, n_views)
        if images is None:
            images = np.zeros(self.shape_out, np.float64 if self._float64 else np.float32)
        return to_caller(images, x)

    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        if self._parts:
            n = len(self._parts)
            return sum(A._run_back(y, part_of(progress, k, n), mu) for k, A in enumerate(self._parts))
        execution = self._execution(y)
        given = images = execution.to_backend(y)
        needed = images.itemsize * self.grid.n_voxels + self._extra_bytes(images.itemsize)
        self._require(needed, f"the adjoint into {shape_text(self.grid.shape)} voxels")
        self._require_rays()
        n = len(self.views)
        tell(progress, 0, n)
        images = self._responded(images)
        if self._depths is not None:
            arguments = *self._depth_arguments(images), lambda done: tell(progress, done, n), self._mu_field(mu)
            volume = self._depths.backproject(*arguments)
            for m, box, close, of_part in self._close_parts:
                volume[box] += np.where(close, of_part.T._run(to_numpy(given[m : m + 1], None), mu=mu), 0)
        elif not self.model.weights_voxels:
            volume = execution.backproject(images, self._bundles, self._mu(mu), lambda done: tell(progress, done, n))
        else:  # each view's volume is weighted before it is added to the total
            volume = zeros(self.grid.shape, images)
            for m in range(n):
                of_view = execution.backproject(images[m : m + 1], self._bundles_of(m))
                volume += of_view * self._voxel_weights(m, of_view)
                tell(progress, m + 1, n)
        return to_caller(self._finished(volume, y), y)

    def _images(self, x: ArrayOrTensor, mu: ArrayOrTensor = None) -> Iterator[ArrayOrTensor]:
        """Images of a checked volume, as the backend computes them."""
        if self._parts:
            yield from map(sum, zip(*(A._images(x, mu) for A in self._parts), strict=True))
            return
        self._require_rays()
        execution = self._execution(x)
        for m, image in enumerate(self._projected(execution, x, mu)):
            response = self.model.response(self.views, m)
            if response is not None:
                along_v, along_u = (cast_like(matrix, image) for matrix in response)
                image = along_v @ image @ along_u.T
            if self._efficiency is not None:  # close parts have theirs
                image = image * cast_like(self._efficiency[m], image)
            for view, box, close, A in self._close_parts:
                if view == m and (part := np.where(close, to_numpy(x[box], None), 0)).any():
                    image = image + cast_like(A(part, mu=mu)[0], image)
            yield self._finished(image, x)

    def _projected(self, execution: Execution, x: ArrayOrTensor, mu: ArrayOrTensor) -> Iterator[ArrayOrTensor]:
        """The images before the detector's response."""
        if self._depths is not None:
            yield from self._depths.images(*self._depth_arguments(x), self._mu_field(mu))
            return
        if not self.model.weights_voxels:
            yield from execution.images(x, self._bundles, self._mu(mu))
            return
        x = execution.to_backend(x)
        for m in range(len(self.views)):
            yield from execution.images(x * self._voxel_weights(m, x), self._bundles_of(m))

    def _mu_gradient(self, images: ArrayOrTensor, x: ArrayOrTensor, mu: ArrayOrTensor) -> ArrayOrTensor:
        """The gradient of <A x, images> by mu, on mu's whole grid; of a batch the sum."""
        if self._parts:
            return sum(A._mu_gradient(images, x, mu) for A in self._parts)
        execution = self._execution(x)
        total = zeros(mu.shape, images)
        for index in np.ndindex(x.shape[:-3]):
            responded = self._responded(execution.to_backend(images[index]))
            own = x[index].detach(), mu.detach()
            if self._depths is None:
                gradient = execution.mu_gradient(responded, self._bundles, *own)
            else:
                gradient = self._depth_mu_gradient(images[index], responded, *own)
            total += to_caller(self._finished(gradient, images), images)
        return total

    def _responded(self, images: ArrayOrTensor) -> ArrayOrTensor:
        """`images` with the adjoint of the detector's response and efficiency."""
        if self._efficiency is not None:
            images = images * cast_like(self._efficiency, images)
        for m in range(len(self.views)):
            response = self.model.response(self.views, m)
            if response is None:
                return images
            if m == 0:
                images = images + 0  # a copy: the caller's stay as they are
            along_v, along_u = (cast_like(matrix, images) for matrix in response)
            images[m] = along_v.T @ images[m] @ along_u
        return images

    def _bundle(self, m: int) -> Bundle:
        return Bundle.along(self.grid, *self.model.beams(self.views, m, self.grid))

    def _execution(self, x: ArrayOrTensor) -> Execution:
        """What computes with the rays, for an array or tensor such as `x`."""
        on_gpu = self._auto and is_tensor(x) and x.device.type != "cpu"
        backend = backends.for_tensor(x) if on_gpu else self._backend
        mu_grid = None if self.model.mu is None else self.model.mu.grid
        float64 = self._float64 or backend.always_float64 or is_double(x)
        return Execution(backend, self.grid, mu_grid, float64, self.threads)

    def _depth_arguments(self, x: ArrayOrTensor) -> tuple[ArrayOrTensor, Any, int]:
        """What `WholeHoles` takes: the array, the functions and the threads."""
        double = self._float64 or self._backend.always_float64 or is_double(x)
        has_kernels = self._backend.name != "numpy" and backends.choose("auto").name == "cpu"
        functions = backends.load("cpu" if has_kernels else "reference_depth")
        return np.ascontiguousarray(to_numpy(x, np.float64 if double else np.float32)), functions, self.threads

    def _depth_mu_gradient(
        self, images: ArrayOrTensor, responded: ArrayOrTensor, x: ArrayOrTensor, mu: ArrayOrTensor
    ) -> Array:
        """The gradient by mu of the depth-dependent response, and of the voxels that are too close to a pinhole for it."""
        volume, *how = self._depth_arguments(x)
        arguments = volume, to_numpy(responded, None), *how, self._mu_field(mu)
        gradient: Array = self._depths.mu_gradient(*arguments)  # type: ignore[union-attr]
        for m, box, close, of_part in self._close_parts:
            part, image = cast_like(np.where(close, to_numpy(x[box], None), 0), x), cast_like(images[m : m + 1], x)
            gradient += to_numpy(of_part._mu_gradient(image, part, mu), None)
        return gradient

    @functools.cached_property
    def _efficiency(self) -> Array | None:
        """That of the model, (M, n_v, n_u) or (M, 1, 1); None where it is 1."""
        values = each_pixel(self.model.efficiency)
        return None if np.all(values == 1) else np.broadcast_to(values, (len(self.views), *values.shape[1:]))

    @functools.cached_property
    def _close_parts(self) -> list[tuple[int, Any, NDArray[np.bool_], Projector]]:
        """The voxels so close to a pinhole that rays project them: view, a box of the grid, which in it, their projector."""
        parts = []
        for m in range(len(self.views)):
            found = None if self._depths is None else self._depths.close(m)
            if found is not None:
                box, close = found
                grid, which = self.grid.box([each.start for each in box], close.shape), np.array([m])
                model = self.model.of_views(which).by_rays()
                with recorded_warnings():
                    parts.append((m, box, close, Projector(grid, self.views[which], model, **self._settings)))
        return parts

    def _mu_field(self, mu: ArrayOrTensor) -> Field | None:
        """`mu` on the grid of the model's."""
        return None if mu is None else Field(to_numpy(mu, None), self.model.mu.grid)  # type: ignore[union-attr]

    def _mu(self, mu: ArrayOrTensor) -> ArrayOrTensor:
        return self.model.mu.array if mu is None and self.model.mu is not None else mu

    def _bundles_of(self, m: int) -> Bundles:
        """The rays of view m alone."""
        return Bundles(1, lambda _: self._bundles[m])

    def _voxel_weights(self, m: int, like: ArrayOrTensor) -> ArrayOrTensor:
        return cast_like(self.model.voxel_weights(self.views, m, self.grid), like)

    def _extra_bytes(self, itemsize: int) -> int:
        """Bytes of a copy of mu, and of voxel weights and the volume that they weight."""
        if self._parts:
            return max(part._extra_bytes(itemsize) for part in self._parts)
        mu = 0 if self.model.mu is None else self.model.mu.grid.n_voxels
        return itemsize * mu + (2 * itemsize + 8) * self.grid.n_voxels * self.model.weights_voxels

    def _require_rays(self) -> None:
        n_v, n_u = self.views.shape
        # An image of float32, and some arrays of float64 from which the weights of its rays are made.
        self._require(110 * n_v * n_u, f"an image of {n_v} x {n_u} pixels, with its rays,")

    def _finished(self, result: ArrayOrTensor, x: ArrayOrTensor) -> ArrayOrTensor:
        """`result` as float32, unless it is to be float64 (where "auto" falls back to numpy it is not)."""
        if self._float64 or is_tensor(result) or is_double(x):
            return result
        return result.astype(np.float32, copy=False)


def _describe(grid: Grid) -> str:
    return f"{shape_text(grid.shape)} voxels of {' x '.join(f'{s:.6g}' for s in grid.spacing)} mm"
