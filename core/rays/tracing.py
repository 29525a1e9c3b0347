"""Line integrals along rays given by their ends or as fans; in torch with gradients by the volume and by the rays."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import ArrayOrTensor, Floats, checked, is_double, is_tensor, namespace, promote, to_caller, uncompiled
from ..errors import InputError
from ..geometry.grid import Grid
from ..validation import instance, require_finite, shape_text, whole_shape
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from . import backends
from .bundles import Batch, Beam, Bundles, RayBundle
from .execution import Execution
from .lattices import require_no_negative
from .parallel import in_order, thread_count
from .ray_geometry import Ends, Fan
from .ray_gradients import geometry_gradient

if TYPE_CHECKING:
    from torch import Tensor

AnyVolume = Volume | ArrayOrTensor


@uncompiled
def trace_rays(
    volume: Volume | ArrayOrTensor,
    sources: ArrayLike | ArrayOrTensor,
    targets: ArrayLike | ArrayOrTensor,
    backend: str = "auto",
    grid: Grid | None = None,
    mu: Volume | ArrayOrTensor | None = None,
    mu_grid: Grid | None = None,
) -> ArrayOrTensor:
    """Return line integrals of a volume along rays, attenuated towards their sources if `mu` is given.

    Parameters
    ----------
    volume
        Volume that is integrated; outside its voxels it is 0. A `Volume` of activity or mu (with `mu`, of activity), or an
        array or tensor (n_x, n_y, n_z) on `grid`.
    sources, targets
        Ends of the rays, each (N, 3), or (3,) if it is the same for all rays; world mm. Arrays or torch tensors.
    backend
        One of the backends of `Projector`.
    grid
        Grid of a volume that is an array or a tensor.
    mu
        Attenuation coefficients, 1/mm: the integrals are of ``volume exp(-integral of mu from the source)``. A `Volume` of
        mu, or an array or tensor on `mu_grid`.
    mu_grid
        Grid of mu; the volume's grid if None.

    Returns
    -------
    array or tensor (N,)
        Line integrals from source to target, value x mm. From arrays: float32, or float64 for ``backend="numpy"``. If any
        argument is a tensor: a tensor of the ends' type (of the volume's where the ends are arrays), computed in float64 if
        any tensor is of float64, and part of torch's graph. Its gradients, by the volume, mu and the rays' ends, are exact
        wherever they exist: by the ends they follow from the jumps of the volume and of mu at the planes crossed, for every
        backend. A ray of length 0 has gradient 0. Gradients of gradients are refused.

    Raises
    ------
    InputError
        The volume is none, or one without meaningful line integrals (CT numbers, maps); the points' shapes do not fit; a
        coordinate, or a voxel that a ray meets, is not finite; mu is negative; or there is no such backend.

    Examples
    --------
    >>> grid = Grid.centered((3, 3, 3), 1.0)
    >>> source = torch.tensor([0.2, 0.1, -9.0], requires_grad=True)
    >>> trace_rays(np.ones(grid.shape), source, [0.0, 0.0, 9.0], grid=grid).sum().backward()
    """
    array, mu, execution = _execution(volume, backend, grid, mu, mu_grid, (sources, targets))
    in_torch = any(is_tensor(value) for value in (array, sources, targets))
    starts, ends = (_points(x, name, in_torch) for x, name in ((sources, "sources"), (targets, "targets")))
    if len(starts) != len(ends) and 1 not in (len(starts), len(ends)):
        raise InputError(f"trace_rays: {len(starts)} sources but {len(ends)} targets")
    n = len(ends) if len(starts) == 1 else len(starts)
    xp = namespace(starts)
    rays = xp.stack([xp.broadcast_to(points, (n, 3)) for points in (starts, ends)])
    integrals = _trace(array, mu, rays, lambda rays: Bundles(1, lambda _: RayBundle(ends=Ends(*rays))), execution)
    return _as_input(integrals.reshape(n), array, sources, targets)


@uncompiled
def trace_fans(
    volume: Volume | ArrayOrTensor,
    vectors: ArrayLike | ArrayOrTensor,
    shape: tuple[int, int],
    backend: str = "auto",
    grid: Grid | None = None,
    mu: Volume | ArrayOrTensor | None = None,
    mu_grid: Grid | None = None,
) -> ArrayOrTensor:
    """Return line integrals along fans of rays: `trace_rays` for images, whose rays need not be listed.

    Parameters
    ----------
    vectors
        Vectors of the fans, (..., 4, 3), world mm: source, corner, row step and column step. The ray of row i and column j
        goes from the source to ``corner + i row_step + j column_step``. An array or a torch tensor.
    shape
        Number of rows and columns.
    volume, backend, grid, mu, mu_grid
        Volume, backend and attenuation, as in `trace_rays`.

    Returns
    -------
    array or tensor (..., rows, columns)
        Line integrals, value x mm, of the kind that `trace_rays` returns. Gradients by the vectors take little more time
        than the integrals.

    Examples
    --------
    >>> grid = Grid.centered((3, 3, 3), 1.0)
    >>> fan = torch.tensor([[0.0, 0.0, -9.0], [-2.0, -2.0, 9.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], requires_grad=True)
    >>> trace_fans(np.ones(grid.shape), fan, (5, 5), grid=grid).sum().backward()
    """
    shape = whole_shape(shape, "shape of a fan", 2)
    array, mu, execution = _execution(volume, backend, grid, mu, mu_grid, (vectors,))
    numbers = _numbers(vectors, "vectors", (4, 3), is_tensor(array) or is_tensor(vectors))

    def bundles(vectors: Floats) -> Bundles:
        """Return the bundles of rays of the fans' vectors."""
        fans = vectors.reshape(-1, 4, 3)

        def bundle(number: int) -> RayBundle:
            """Return the rays of fan `number`."""
            source, corner, row_step, column_step = fans[number]
            return RayBundle.along(execution.grid, Beam(Fan(source, corner, row_step, column_step, shape)))

        return Bundles(len(fans), bundle)

    integrals = _trace(array, mu, numbers, bundles, execution)
    return _as_input(integrals.reshape(*numbers.shape[:-2], *shape), array, vectors)


def _execution(
    volume: AnyVolume, backend: str, grid: Grid | None, mu: AnyVolume, mu_grid: Grid | None, geometry: tuple[Any, ...]
) -> tuple[ArrayOrTensor, ArrayOrTensor, Execution]:
    """Return the volume and mu, checked, both arrays or both tensors, and the execution for rays of that `geometry`."""
    if isinstance(volume, Volume):  # mu itself is not attenuated
        require_quantity(volume.quantity, LINE_INTEGRALS if mu is None else ("activity",), "line integrals")
    chosen = backends.choose(backend)
    is_reference = chosen.always_float64 and backend != "auto"
    array, grid = _array_and_grid(volume, "volume", grid, is_reference)
    if mu is not None:
        if isinstance(mu, Volume):
            require_quantity(mu.quantity, ("mu",), "mu")
        mu_grid = mu_grid if isinstance(mu, Volume) else mu_grid or grid
        mu, mu_grid = _array_and_grid(mu, "mu", mu_grid, is_reference)
        array, mu = promote(array, require_no_negative(mu))
    if is_tensor(array) and array.device.type != "cpu" and backend == "auto":
        chosen = backends.for_tensor(array)
    float64 = chosen.always_float64 or any(is_double(value) for value in (array, mu, *geometry))
    return array, mu, Execution(chosen, grid, mu_grid, float64, thread_count(None), whole_for_few=True)


def _array_and_grid(value: AnyVolume, name: str, grid: Grid | None, float64: bool) -> tuple[ArrayOrTensor, Grid]:
    """Return the array or tensor of a volume, and its grid; raise `InputError` if it has none or two."""
    if isinstance(value, Volume):
        if grid is not None and grid != value.grid:
            raise InputError(f"{name} is a Volume and has a grid; leave the other out")
        return value.array, value.grid
    if grid is None:
        raise InputError(f"{name}: expected a Volume, or also a grid, got {type(value).__name__}")
    instance(grid, Grid, f"grid of {name}")
    # Reading all of a large tensor takes as long as tracing it: a volume that is not finite shows in its integrals.
    return checked(value, name, grid.shape, float64, finite=name == "volume"), grid


def _numbers(value: Any, name: str, last: tuple[int, ...], in_torch: bool) -> Any:
    """Return numbers (..., *last) as float64; with `in_torch` as a tensor on the CPU, part of its graph."""
    value = checked(value, name, last, True, batch=True)
    if not in_torch:
        return value
    import torch

    return value.to("cpu") if is_tensor(value) else torch.from_numpy(value.copy())


def _points(value: Any, name: str, in_torch: bool) -> Any:
    """Return points (n, 3), from one (3,) or many."""
    if isinstance(value, list | tuple) and not len(value):
        value = np.empty((0, 3))
    points = _numbers(value, name, (3,), in_torch)
    if points.ndim > 2:
        raise InputError(f"{name}: expected shape any x 3, got {shape_text(tuple(points.shape))}")
    return points.reshape(-1, 3)


def _trace(
    volume: Any, mu: Any, geometry: Any, make_bundles: Callable[[Floats], Bundles], execution: Execution
) -> ArrayOrTensor:
    """Return the line integrals (images, rows, columns) of the rays ``make_bundles(geometry)``.

    They are float32, or float64 where the execution is. If the geometry is a tensor they are a step of torch's graph.
    """
    dtype = np.float64 if execution.float64 else np.float32

    def project(bundles: Bundles, volume: Any, mu: Any) -> Floats:
        """Return the line integrals (images, rows, columns) as an array of `dtype`."""
        return np.array([to_caller(image, np.empty(0)) for image in execution.images(volume, bundles, mu)], dtype)

    if not is_tensor(geometry):
        return project(make_bundles(geometry), volume, mu)
    import torch

    from . import autograd

    bundles = make_bundles(geometry.numpy(force=True))
    volume_data, mu_data = (x.detach() if is_tensor(x) else x for x in (volume, mu))

    def integrals_and_gradient(needs: Any) -> Any:
        """Return the line integrals, and the function that turns their gradient into those of volume, mu and geometry."""
        batches: list[tuple[Batch, Floats]] = []
        if needs[2]:
            integrals = np.zeros((len(bundles), *bundles.image_shape), dtype)
            batches = execution.derivatives(volume_data, bundles, mu_data, integrals)
        else:
            integrals = project(bundles, volume_data, mu_data)
        if not np.isfinite(integrals).all():
            require_finite(to_caller(volume_data, integrals), "volume")

        def input_gradients(gradient: Tensor, needs: Any) -> list[Tensor | None]:
            """Return the gradients by volume, mu and geometry where they are needed, None for the others."""
            result: list[Tensor | None] = [None, None, None]
            if needs[0] or needs[1]:
                values = gradient.to(volume_data)  # the torch backend works on the device of the values
            if needs[0]:
                result[0] = torch.as_tensor(execution.backproject(values, bundles, mu_data)).to(values)
            if needs[1]:
                result[1] = torch.as_tensor(execution.mu_gradient(values, bundles, volume_data, mu_data)).to(values)
            if needs[2]:
                d_geometry = _rays_gradient(gradient.numpy(force=True), batches, bundles, execution)
                result[2] = torch.from_numpy(d_geometry).reshape(geometry.shape)
            return result

        return torch.from_numpy(integrals), input_gradients

    return autograd.step(integrals_and_gradient, volume, mu, geometry)


def _rays_gradient(
    gradient: Floats, batches: list[tuple[Batch, Floats]], bundles: Bundles, execution: Execution
) -> Floats:
    """Return the gradient by fans (images, 4, 3), or by starts and ends (2, rays, 3), from that by the images."""
    grids = execution.grid, execution.mu_grid or execution.grid
    results = in_order(lambda batch: geometry_gradient(gradient, *batch, *grids), batches, execution.workers)
    numbered = [pair for result in results for pair in result]
    if len(bundles) and bundles[0].ends is not None:
        return np.concatenate([np.empty((2, 0, 3)), *(d_ends for _, d_ends in numbered)], axis=1)
    total = np.zeros((len(bundles), 4, 3))
    for number, d_fan in numbered:
        total[number] += d_fan
    return total


def fan_gradient(execution: Execution, bundles: Bundles, volume: Floats, mu: Floats | None) -> Floats:
    """Return the gradient (4, 3) of the sum of a fan's integrals by its source, corner, row step and column step."""
    ones = np.ones((1, *bundles.image_shape))
    batches = execution.derivatives(volume, bundles, mu, np.zeros_like(ones))
    return _rays_gradient(ones, batches, bundles, execution).reshape(4, 3)


def _as_input(integrals: ArrayOrTensor, volume: Any, *geometry: Any) -> ArrayOrTensor:
    """Return `integrals` in the type of the geometry's tensors, or else of the volume's, on the first tensor's device."""
    if not (tensors := [x for x in (volume, *geometry) if is_tensor(x)]):
        return integrals
    import torch

    dtypes = [x.dtype for x in geometry if is_tensor(x) and x.is_floating_point()]
    dtype = functools.reduce(torch.promote_types, dtypes or [tensors[0].dtype])
    return integrals.to(tensors[0].device, dtype if dtype.is_floating_point else torch.float64)
