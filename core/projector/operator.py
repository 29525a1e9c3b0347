"""The projector: the linear operator from a volume to the images of views, by rays or by the pinhole response."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import (
    Array,
    ArrayOrTensor,
    cast_like,
    checked,
    is_double,
    is_tensor,
    promote,
    to_caller,
    to_numpy,
    uncompiled,
    zeros,
)
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import Requirements
from ..models.model import Model, Transmission, with_image_axes
from ..pinhole_response.pinhole_operator import depth_backend
from ..pinhole_response.transmittance import ArrayOnGrid
from ..progress import Progress, part_of, tell
from ..rays import backends
from ..rays.bundles import Bundles, RayBundle
from ..rays.execution import Execution
from ..rays.lattices import require_no_negative, same_lattice
from ..rays.linear_operator import LinearOperator
from ..rays.parallel import thread_count
from ..recording import recorded_warnings
from ..validation import freeze, shape_text
from ..volumes.images import Images
from ..volumes.volume import AIR_HU, CONVERT, Volume
from .subsets import balanced_subsets

_PADDING = (-2000.0, -2048.0, -3024.0)  # values that CT scanners write outside the scanned region
_NARROW = 1.0  # mm: bodies are wider, and a grid of so many metres hardly fits into a scanner


class Projector(LinearOperator):
    """Linear map from a volume to the images of M views, and its exact adjoint.

    Parameters
    ----------
    grid : Grid
        Grid of the voxels. Values outside are 0.
    views : Views
        The M views: rays from each source to the centres of the pixels.
    model : Transmission or Emission
        Model of what a pixel measures; by default the line integral.
    backend : str
        ``"numpy"`` (the float64 reference), ``"torch"`` (on the device of a tensor), ``"cpu"`` (compiled, on the
        processor), ``"cuda"`` (NVIDIA GPUs; ``pip install warp-lang``), or ``"auto"``: cpu where there are kernels for the
        platform, else torch, else numpy; for a tensor on a GPU cuda if it works there, else torch. Arrays go to a GPU with
        ``"cuda"`` alone.
    threads : int, optional
        Number of threads of cpu and numpy, by default one per core (torch has a setting of its own, cuda needs none). The
        images do not depend on it; the adjoint does by float32 rounding, and is the same every time for a given number.
        The adjoint takes a volume per thread, so it uses at most 8, and fewer when memory is short.
    double : bool
        Whether to compute in float64, also from float32; not with cuda.

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
    call to call. Up to 128 MiB of rays and their weights are stored from call to call, with lines apart for each line.

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
        for value, kind, expected in (
            (grid, Grid, "grid to be Grid"),
            (views, Views, "views to be Views"),
            (model, Model, "model to be Transmission, Emission or another model"),
        ):
            if not isinstance(value, kind):
                raise InputError(f"projector: expected {expected}, got {type(value).__name__}")
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
        self.threads = thread_count(threads)
        self.which = freeze(np.arange(len(views)))
        parts = model.parts()
        with recorded_warnings():  # they are those of this projector
            self._parts = [Projector(grid, views, part, **self._settings) for part in parts if part is not model]
        self._set_pixel_parts(model.pixel_parts(views, grid))
        for text in _warnings(grid, self._fine_views, model):
            warn(text, 2)

    def _set_pixel_parts(self, n: int) -> None:
        """Compute images with `n` parts along a pixel's side, whose means the detector's response takes."""
        self._pixel_parts, self._fine_views = n, self.views if n == 1 else self.views.finer(n)
        self._bundles = Bundles(len(self.views), self._bundle)
        self._pinholes = None if self._parts else self.model.by_depth(self._fine_views, self.grid)

    def _take_pixel_parts(self, of_all: Projector) -> None:
        """Compute images with as many parts of pixels as `of_all`, and so on with the model's parts and with theirs."""
        if self._pixel_parts != of_all._pixel_parts:
            self._set_pixel_parts(of_all._pixel_parts)
        for part, of_part in zip(self._parts, of_all._parts, strict=True):
            part._take_pixel_parts(of_part)

    @uncompiled
    def __call__(
        self, x: Volume | ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None
    ) -> ArrayOrTensor:
        """Return the images of a volume.

        Parameters
        ----------
        x, progress
            Volume, (..., n_x, n_y, n_z) or a `Volume`, and progress, as of any `LinearOperator`.
        mu
            Attenuation coefficients, 1/mm, in place of the model's: an array or tensor on the grid of the model's `mu`, one
            for a whole batch.

        Returns
        -------
        array or tensor (..., M, n_v, n_u)
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
        from ..rays import autograd

        def images_and_gradient(_needs: Any) -> Any:
            """Return the images, and the function that turns their gradient into those of `x` and `mu`."""

            def input_gradients(d_images: ArrayOrTensor, needs: Any) -> Any:
                """Return the gradients by `x` and by `mu` of a loss with the gradient `d_images` by the images."""
                needs_x, needs_mu = needs
                d_x = self.T._run(d_images, mu=mu) if needs_x else None
                return d_x, self._mu_gradient(d_images, x, mu) if needs_mu else None

            return self._run(x.detach(), progress, mu.detach()), input_gradients

        return autograd.step(images_and_gradient, x, mu)

    @property
    def backend(self) -> str:
        """Name of the backend, also where "auto" has chosen it."""
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
        """Expected counts of the model besides the volume's, (M, n_v, n_u), read-only: all are ``A(x) + A.background``.

        Dead pixels have none.
        """
        values = with_image_axes(self.model.background)
        return freeze(np.where(self.living, values, 0.0)) if values.any() else np.broadcast_to(values, self.shape_out)

    @property
    def living(self) -> NDArray[np.bool_]:
        """Mask (M, n_v, n_u), read-only, of the pixels that are not dead: their efficiency in the model is not 0."""
        return np.broadcast_to(with_image_axes(self.model.efficiency) > 0, self.shape_out)

    def iter_views(self, volume: Volume | ArrayOrTensor) -> Iterator[ArrayOrTensor]:
        """Yield the images (n_v, n_u) one by one, so that a job can stop between them; gradients are not recorded.

        The volume must not change before the last image: images are computed ahead of need.
        """
        volume = self._check(volume, batch=False)
        return (to_caller(image, volume) for image in self._images(volume))

    def subsets(self, n: int) -> list[Projector]:
        """Return `n` projectors of disjoint subsets of the views, balanced over rings and angles.

        The sizes of subsets differ by one at most; the attribute `which` of each has the indices of its views. Raise
        `InputError` if `n` is not from 1 to the number of views.
        """
        projectors: list[Projector] = []
        with recorded_warnings():  # they are those of this projector
            for indices in balanced_subsets(self.views, n):
                subset = self.grid, self.views[indices], self.model.of_views(indices)
                projectors.append(copy.copy(self) if n == 1 else Projector(*subset, **self._settings))
                projectors[-1].which = freeze(indices)
                projectors[-1]._take_pixel_parts(self)  # images are those of all views
        return projectors

    def __repr__(self) -> str:
        voxels, pixels = shape_text(self.grid.shape), shape_text(self.views.shape)
        return f"Projector({voxels} voxels, {len(self.views)} views of {pixels}, {self.backend})"

    def _check(self, x: Volume | ArrayOrTensor, batch: bool = True) -> ArrayOrTensor:
        """Return the checked array of a volume; warn if its values seem to be CT numbers."""
        if isinstance(x, Volume):
            if not same_lattice(x.grid, self.grid):
                actual, expected = map(_describe, (x.grid, self.grid))
                raise InputError(f"volume: its grid ({actual}) is not the projector's ({expected})")
            self.model.check_volume(x)
        array = x.array if isinstance(x, Volume) else checked(x, "volume", self.shape_in, self._float64, batch)
        # A thousand voxels or so are a sample: to look at all would take as long as an image.
        sample: Any = (..., *(slice(n // 20, None, 1 + n // 10) for n in self.shape_in))
        values = to_numpy(array[sample], np.float32)
        is_air = np.isin(values, _PADDING) | (abs(values - AIR_HU) < 50)
        if np.count_nonzero(is_air) > 0.05 * is_air.size:
            warn(f"volume: {np.mean(is_air):.0%} of its values are those of air in CT numbers{CONVERT}", 6)
        return array

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Return the images (M, n_v, n_u) of a checked volume (n_x, n_y, n_z), with `mu` in place of the model's."""
        n_views, n_v, n_u = self.shape_out
        itemsize = 8 if self._float64 or is_double(x) else 4
        work = f"projecting {shape_text(self.shape_in)} voxels into {n_views} images of {n_v} x {n_u} pixels"
        self._require(itemsize * (n_views * n_v * n_u + self.grid.n_voxels) + self._extra_bytes(itemsize), work)
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
        """Return the adjoint (n_x, n_y, n_z) of checked images (M, n_v, n_u), with `mu` in place of the model's."""
        if self._parts:
            n = len(self._parts)
            return sum(A._run_back(y, part_of(progress, k, n), mu) for k, A in enumerate(self._parts))
        execution = self._execution(y)
        detected = execution.to_backend(y)
        n_bytes = detected.itemsize * (self.grid.n_voxels + len(self.views) * math.prod(self._fine_views.shape))
        n_bytes += self._extra_bytes(detected.itemsize)
        self._require(n_bytes, f"the adjoint into {shape_text(self.grid.shape)} voxels")
        self._require_rays()
        n = len(self.views)
        tell(progress, 0, n)
        images = self._response_adjoint(detected)
        if self._pinholes is not None:
            arguments = *self._pinhole_arguments(images), lambda k: tell(progress, k, n), self._mu_on_grid(mu)
            volume = self._pinholes.backproject(*arguments)
            for m, box, is_close, A in self._close_parts:
                volume[box] += np.where(is_close, A.T._run(to_numpy(detected[m : m + 1], None), mu=mu), 0)
        elif not self.model.weights_voxels:
            volume = execution.backproject(images, self._bundles, self._mu(mu), lambda k: tell(progress, k, n))
        else:  # each view's volume is weighted before it is added to the total
            volume = zeros(self.grid.shape, images)
            for m in range(n):
                view_volume = execution.backproject(images[m : m + 1], self._view_bundles(m))
                volume += view_volume * self._voxel_weights(m, view_volume)
                tell(progress, m + 1, n)
        return to_caller(self._as_result(volume, y), y)

    def _images(self, x: ArrayOrTensor, mu: ArrayOrTensor = None) -> Iterator[ArrayOrTensor]:
        """Yield the images of a checked volume, arrays or tensors as the backend computes them."""
        if self._parts:
            yield from map(sum, zip(*(A._images(x, mu) for A in self._parts), strict=True))
            return
        self._require_rays()
        execution = self._execution(x)
        for m, image in enumerate(self._plain_images(execution, x, mu)):
            if (response := self.model.response(self.views, m, self._pixel_parts)) is not None:
                along_v, along_u = (cast_like(matrix, image) for matrix in response)
                image = along_v @ image @ along_u.T
            if self._efficiency is not None:  # the projectors of close voxels have their own
                image = image * cast_like(self._efficiency[m], image)
            for view, box, is_close, A in self._close_parts:
                if view == m and (voxels := np.where(is_close, to_numpy(x[box], None), 0)).any():
                    image = image + cast_like(A(voxels, mu=mu)[0], image)
            yield self._as_result(image, x)

    def _plain_images(self, execution: Execution, x: ArrayOrTensor, mu: ArrayOrTensor) -> Iterator[ArrayOrTensor]:
        """Yield the images before the detector's response and efficiency."""
        if self._pinholes is not None:
            yield from self._pinholes.images(*self._pinhole_arguments(x), self._mu_on_grid(mu))
            return
        if not self.model.weights_voxels:
            yield from execution.images(x, self._bundles, self._mu(mu))
            return
        x = execution.to_backend(x)
        for m in range(len(self.views)):
            yield from execution.images(x * self._voxel_weights(m, x), self._view_bundles(m))

    def _mu_gradient(self, images: ArrayOrTensor, x: ArrayOrTensor, mu: ArrayOrTensor) -> ArrayOrTensor:
        """Return the gradient of <A x, images> by mu, on mu's whole grid; for a batch the sum."""
        if self._parts:
            return sum(A._mu_gradient(images, x, mu) for A in self._parts)
        execution = self._execution(x)
        total = zeros(mu.shape, images)
        for index in np.ndindex(x.shape[:-3]):
            before_response = self._response_adjoint(execution.to_backend(images[index]))
            volumes = x[index].detach(), mu.detach()
            if self._pinholes is None:
                gradient = execution.mu_gradient(before_response, self._bundles, *volumes)
            else:
                volume, *settings = self._pinhole_arguments(volumes[0])
                arguments = volume, to_numpy(before_response, None), *settings, self._mu_on_grid(volumes[1])
                gradient = self._pinholes.mu_gradient(*arguments)
                for m, box, is_close, A in self._close_parts:
                    voxels = cast_like(np.where(is_close, to_numpy(volumes[0][box], None), 0), volumes[0])
                    image = cast_like(images[index][m : m + 1], volumes[0])
                    gradient += to_numpy(A._mu_gradient(image, voxels, volumes[1]), None)
            total += to_caller(self._as_result(gradient, images), images)
        return total

    def _response_adjoint(self, images: ArrayOrTensor) -> ArrayOrTensor:
        """Return the adjoint of the detector's response and efficiency for `images` (M, n_v, n_u)."""
        if self._efficiency is not None:
            images = images * cast_like(self._efficiency, images)
        result = images
        for m in range(len(self.views)):
            if (response := self.model.response(self.views, m, self._pixel_parts)) is None:
                return images
            if m == 0:
                result = zeros((len(self.views), *self._fine_views.shape), images)
            along_v, along_u = (cast_like(matrix, images) for matrix in response)
            result[m] = along_v.T @ images[m] @ along_u
        return result

    def _bundle(self, m: int) -> RayBundle:
        """Return the rays of view m."""
        return RayBundle.along(self.grid, *self.model.beams(self._fine_views, m, self.grid))

    def _execution(self, x: ArrayOrTensor) -> Execution:
        """Return the execution that traces the rays, for arrays or tensors such as `x`."""
        on_gpu = self._auto and is_tensor(x) and x.device.type != "cpu"
        backend = backends.for_tensor(x) if on_gpu else self._backend
        mu_grid = None if self.model.mu is None else self.model.mu.grid
        float64 = self._float64 or backend.always_float64 or is_double(x)
        return Execution(backend, self.grid, mu_grid, float64, self.threads)

    def _pinhole_arguments(self, x: ArrayOrTensor) -> tuple[ArrayOrTensor, Any, int]:
        """Return the arguments of a `PinholeOperator`: `x` as an array, the module that computes, and the threads."""
        double = self._float64 or self._backend.always_float64 or is_double(x)
        array = np.ascontiguousarray(to_numpy(x, np.float64 if double else np.float32))
        return array, depth_backend(self._backend.name), self.threads

    @functools.cached_property
    def _efficiency(self) -> Array | None:
        """Efficiency of the model, (M, n_v, n_u) or (M, 1, 1); None if it is 1 everywhere."""
        values = with_image_axes(self.model.efficiency)
        return None if np.all(values == 1) else np.broadcast_to(values, (len(self.views), *values.shape[1:]))

    @functools.cached_property
    def _close_parts(self) -> list[tuple[int, Any, NDArray[np.bool_], Projector]]:
        """Voxels too close to a pinhole for its response: view, box of the grid, mask in the box, projector by rays."""
        parts = []
        for m in range(len(self.views)):
            close = None if self._pinholes is None else self._pinholes.close_voxels(m)
            if close is not None:
                box, is_close = close
                grid, view = self.grid.box([part.start for part in box], is_close.shape), np.array([m])
                model = self.model.of_views(view).by_rays()
                with recorded_warnings():
                    parts.append((m, box, is_close, Projector(grid, self.views[view], model, **self._settings)))
        return parts

    def _mu_on_grid(self, mu: ArrayOrTensor) -> ArrayOnGrid | None:
        """Return `mu` with the grid of the model's."""
        return None if mu is None else ArrayOnGrid(to_numpy(mu, None), self.model.mu.grid)  # type: ignore[union-attr]

    def _mu(self, mu: ArrayOrTensor) -> ArrayOrTensor:
        """Return `mu`, or the model's if that is None."""
        return self.model.mu.array if mu is None and self.model.mu is not None else mu

    def _view_bundles(self, m: int) -> Bundles:
        """Return the rays of view m alone."""
        return Bundles(1, lambda _: self._bundles[m])

    def _voxel_weights(self, m: int, values: ArrayOrTensor) -> ArrayOrTensor:
        """Return the model's factors of the voxels in view m, an array or tensor as `values`."""
        return cast_like(self.model.voxel_weights(self.views, m, self.grid), values)

    def _extra_bytes(self, itemsize: int) -> int:
        """Return the bytes of a copy of mu, and of voxel weights with the weighted volume."""
        if self._parts:
            return max(part._extra_bytes(itemsize) for part in self._parts)
        mu = 0 if self.model.mu is None else self.model.mu.grid.n_voxels
        return itemsize * mu + (2 * itemsize + 8) * self.grid.n_voxels * self.model.weights_voxels

    def _require_rays(self) -> None:
        """Raise `InputError` if there is too little memory for an image and its rays."""
        n_v, n_u = self._fine_views.shape
        # An image of float32, and some arrays of float64 from which the weights of its rays are made.
        self._require(110 * n_v * n_u, f"an image of {n_v} x {n_u} pixels, with its rays,")

    def _as_result(self, result: ArrayOrTensor, x: ArrayOrTensor) -> ArrayOrTensor:
        """Return `result` as float32, unless float64 is asked for; numpy in place of "auto" computes in float64 unasked."""
        if self._float64 or is_tensor(result) or is_double(x):
            return result
        return result.astype(np.float32, copy=False)


def _warnings(grid: Grid, views: Views, model: Model) -> Iterator[str]:
    """Yield the warnings about a projector's arguments that look wrong, each with its number."""
    if caution := model.caution(views, grid):
        yield caution
    if (width := float(np.ptp(grid.corners(), axis=0).max())) < _NARROW and max(grid.shape) > 3:
        distance = float(np.linalg.norm(views.sources - grid.center, axis=1).min())
        yield f"the grid is {width:.3g} mm wide, {distance:.3g} mm from the sources: lengths are in mm; is it in metres?"
    yield from model.coefficient_warnings()


def _describe(grid: Grid) -> str:
    """Return a grid's shape and spacing in words."""
    return f"{shape_text(grid.shape)} voxels of {' x '.join(f'{s:.6g}' for s in grid.spacing)} mm"
