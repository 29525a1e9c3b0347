"""Rays given by their ends, or fan by fan: line integrals, and in torch their gradients by the volume and by the rays."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import ArrayOrTensor, checked, is_double, is_tensor, promote, require_numbers, to_caller
from ..errors import InputError
from ..geometry.grid import Grid
from ..validation import real_array, whole_shape
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from . import backends, ray_gradients
from .bundles import Beam, Bundle, Bundles, Part
from .execution import Execution
from .lattices import require_no_negative
from .parallel import in_order, thread_count
from .rays import Array, Ends, Fan

if TYPE_CHECKING:
    from torch import Tensor


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
    array, mu, execution = _execution(volume, backend, grid, mu, mu_grid, (sources, targets))
    if any(is_tensor(value) for value in (array, sources, targets)):
        return _trace_rays_in_torch(array, sources, targets, mu, execution)
    starts, ends = points(sources, "sources"), points(targets, "targets")
    n = fitting_count(len(starts), len(ends))
    rays = Ends(np.broadcast_to(starts, (n, 3)), np.broadcast_to(ends, (n, 3)))
    return _integrals(execution, array, _of_ends(rays), mu).reshape(n)


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
        The fans, (..., 4, 3), world mm: source, corner, row step and column step. The ray of row i and column j goes from
        the source to ``corner + i row_step + j column_step``. An array or a torch tensor.
    shape
        Rows and columns.
    volume, backend, grid, mu, mu_grid
        As of `trace_rays`.

    Returns
    -------
    array or tensor (..., rows, columns)
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
    shape = whole_shape(shape, "shape of a fan", 2)
    array, mu, execution = _execution(volume, backend, grid, mu, mu_grid, (vectors,))
    if is_tensor(array) or is_tensor(vectors):
        return _trace_fans_in_torch(array, vectors, shape, mu, execution)
    numbers = _fan_vectors(vectors, "vectors")
    integrals = _integrals(execution, array, _of_fans(numbers, shape, execution.grid), mu)
    return integrals.reshape(*numbers.shape[:-2], *shape)


def _execution(
    volume: Volume | ArrayOrTensor,
    backend: str,
    grid: Grid | None,
    mu: Volume | ArrayOrTensor | None,
    mu_grid: Grid | None,
    geometry: tuple[Any, ...],
) -> tuple[ArrayOrTensor, ArrayOrTensor, Execution]:
    """Checked numbers of the volume and of mu, both arrays or both tensors, and what traces rays of that `geometry`."""
    if isinstance(volume, Volume):  # attenuation is not attenuated
        require_quantity(volume.quantity, LINE_INTEGRALS if mu is None else ("activity",), "line integrals")
    chosen = backends.choose(backend)
    reference = chosen.always_float64 and backend != "auto"
    array, grid = _field(volume, "volume", grid, None, reference)
    if mu is not None:
        if isinstance(mu, Volume):
            require_quantity(mu.quantity, ("mu",), "mu")
        mu, mu_grid = _field(mu, "mu", mu_grid, grid, reference)
        array, mu = promote(array, require_no_negative(mu))
    if is_tensor(array) and array.device.type != "cpu" and backend == "auto":
        chosen = backends.for_tensor(array)
    float64 = chosen.always_float64 or any(is_double(value) for value in (array, mu, *geometry))
    return array, mu, Execution(chosen, grid, mu_grid, float64, thread_count(None))


def _of_ends(rays: Ends) -> Bundles:
    return Bundles(1, lambda _: Bundle(ends=rays))


def _of_fans(vectors: Array, shape: tuple[int, int], grid: Grid) -> Bundles:
    """The fans of `vectors` (..., 4, 3)."""
    vectors = vectors.reshape(-1, 4, 3)

    def fan(source: Array, corner: Array, row_step: Array, column_step: Array) -> Fan:
        return Fan(source, corner, row_step, column_step, shape)

    return Bundles(len(vectors), lambda number: Bundle.along(grid, Beam(fan(*vectors[number]))))


def _integrals(execution: Execution, volume: ArrayOrTensor, bundles: Bundles, mu: ArrayOrTensor) -> Array:
    """Line integrals (images, rows, columns): float64 of the reference, else float32."""
    images = [to_caller(image, np.empty(0)) for image in execution.images(volume, bundles, mu)]
    return np.array(images, np.float64 if execution.backend.always_float64 else np.float32)


def _trace_rays_in_torch(volume: Any, sources: Any, targets: Any, mu: Any, execution: Execution) -> Tensor:
    """Line integrals (N,) along rays from `sources` to `targets`, as a step of torch's graph."""
    import torch

    starts, ends = _numbers(sources, points, "sources"), _numbers(targets, points, "targets")
    n = fitting_count(len(starts), len(ends))
    rays = torch.stack([starts.expand(n, 3), ends.expand(n, 3)])
    integrals = _traced(volume, mu, rays, lambda rays: _of_ends(Ends(*rays)), execution)
    return _of_kind(integrals.reshape(n), volume, sources, targets)


def _trace_fans_in_torch(volume: Any, vectors: Any, shape: tuple[int, int], mu: Any, execution: Execution) -> Tensor:
    """Line integrals (..., rows, columns) along the fans of `vectors` (..., 4, 3), likewise."""
    numbers = _numbers(vectors, _fan_vectors, "vectors")
    integrals = _traced(volume, mu, numbers, lambda vectors: _of_fans(vectors, shape, execution.grid), execution)
    return _of_kind(integrals.reshape(*numbers.shape[:-2], *shape), volume, vectors)


def _traced(
    volume: Any, mu: Any, geometry: Tensor, bundles_of: Callable[[Array], Bundles], execution: Execution
) -> Tensor:
    """Line integrals, one after the other, of the rays that ``bundles_of(geometry)`` makes."""
    import torch

    from . import autograd

    bundles = bundles_of(geometry.numpy(force=True))
    volume_data, mu_data = (x.detach() if is_tensor(x) else x for x in (volume, mu))

    def run(needs: Any) -> Any:
        parts: list[tuple[Part, Array]] = []
        if needs[2]:
            parts = execution.derivatives(volume_data, bundles, mu_data)
            images = np.zeros((len(bundles), *bundles.image_shape))
            for part, derivatives in parts:
                part.add_to(images, 0, ray_gradients.integrals(part, derivatives))
        else:
            traced = execution.images(volume_data, bundles, mu_data)
            images = np.array([to_caller(image, np.empty(0)) for image in traced], np.float64)

        def gradients(gradient: Tensor, needs: Any) -> list[Tensor | None]:
            by_volume, by_mu, by_geometry = needs
            found: list[Tensor | None] = [None, None, None]
            if by_volume or by_mu:
                values = gradient.to(volume_data)  # the torch backend works on the device of the values
                if by_volume:
                    found[0] = torch.as_tensor(execution.backproject(values, bundles, mu_data)).to(values)
                if by_mu:
                    found[1] = torch.as_tensor(execution.mu_gradient(values, bundles, volume_data, mu_data)).to(values)
            if by_geometry:
                by_each = _by_geometry(gradient.numpy(force=True), parts, bundles, execution)
                found[2] = torch.from_numpy(by_each).reshape(geometry.shape)
            return found

        return torch.from_numpy(images), gradients

    return autograd.step(run, volume, mu, geometry)


def _by_geometry(gradient: Array, parts: list[tuple[Part, Array]], bundles: Bundles, execution: Execution) -> Array:
    """The gradient by fans (images, 4, 3), or by starts and ends (2, rays, 3)."""

    def of_part(of: tuple[Part, Array]) -> list[tuple[int, Array]]:
        part, derivatives = of
        mu_grid = execution.mu_grid or execution.grid
        return ray_gradients.by_geometry(part, gradient, derivatives, execution.grid, mu_grid)

    results = in_order(of_part, parts, execution.workers)
    if len(bundles) and bundles[0].ends is not None:
        return np.concatenate([np.empty((2, 0, 3)), *(own for result in results for _, own in result)], axis=1)
    total = np.zeros((len(bundles), 4, 3))
    for result in results:
        for number, own in result:
            total[number] += own
    return total


def _numbers(value: Any, checked: Callable[[Any, str], Array], name: str) -> Tensor:
    """`value`, which is `checked`, as a tensor of float64 on the CPU, where rays are made; still in its graph."""
    import torch

    if not is_tensor(value):
        return torch.from_numpy(checked(value, name))
    require_numbers(value, name)
    value = value.to("cpu", torch.float64)
    return value.reshape(checked(value.numpy(force=True), name).shape)


def _of_kind(integrals: Tensor, volume: Any, *geometry: Any) -> Tensor:
    """`integrals` of the type of the geometry's tensors, or else of the volume, on the device of the first tensor."""
    import torch

    given = [x for x in (volume, *geometry) if is_tensor(x)]
    kinds = [x.dtype for x in geometry if is_tensor(x) and x.is_floating_point()]
    kind = functools.reduce(torch.promote_types, kinds or [given[0].dtype])
    return integrals.to(given[0].device, kind if kind.is_floating_point else torch.float64)


def _fan_vectors(value: ArrayLike, name: str) -> Array:
    """`value` as an array (..., 4, 3) of real, finite numbers, or `InputError`."""
    shape = _shape_of(value)
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


def _shape_of(value: ArrayLike) -> tuple[int, ...]:
    """The shape of `value`; () of what `real_array` refuses: what is ragged, or tensors of a graph in a list."""
    try:
        return np.shape(value)
    except (ValueError, RuntimeError):
        return ()


def points(value: ArrayLike, name: str) -> Array:
    """`value`, one point (3,) or many (n, 3), as an array (n, 3), or `InputError`."""
    shape = _shape_of(value)
    if shape == (0,):  # an empty list
        return np.empty((0, 3))
    return real_array(value, name, (3,))[None] if len(shape) == 1 else real_array(value, name, (None, 3))
