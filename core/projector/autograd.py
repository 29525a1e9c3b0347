"""Gradients in torch, whatever the backend: of the operators, and of rays traced one by one."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..arrays import require_numbers
from ..errors import InputError
from .tracing import Bundle, Ends, fan_vectors, fans, fitting_count, points

if TYPE_CHECKING:
    from ..progress import Progress
    from .operator import LinearOperator, Projector
    from .tracing import Tracer

Bundles = Callable[[NDArray[np.float64]], Sequence[Bundle]]
Gradients = Callable[[Tensor], Sequence[Tensor | None]]


def apply(operator: LinearOperator, x: Tensor, progress: Progress | None = None) -> Tensor:
    """``operator(x)`` as a step of torch's graph."""
    result: Tensor = _Apply.apply(x, operator, progress)
    return result


class _Apply(torch.autograd.Function):
    """A linear map: its derivative is itself, and the gradient is its adjoint's (to any order)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, operator: LinearOperator, progress: Progress | None) -> Tensor:
        ctx.operator = operator
        return operator._run(x.detach(), progress)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return apply(ctx.operator.T, gradient), None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        return apply(ctx.operator, tangent)


def apply_attenuated(projector: Projector, x: Tensor, mu: Tensor, progress: Progress | None = None) -> Tensor:
    """``projector(x)``, which attenuates by `mu`, as a step of torch's graph."""
    if not mu.requires_grad:
        return apply(projector, x, progress)
    result: Tensor = _ApplyAttenuated.apply(x, mu, projector, progress)
    return result


class _ApplyAttenuated(torch.autograd.Function):
    """A projector as a function of the volume, in which it is linear, and of mu, in which it is not."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, mu: Tensor, projector: Projector, progress: Progress | None) -> Tensor:
        ctx.projector = projector
        ctx.save_for_backward(x, mu)
        return projector._run(x, progress)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        x, mu = ctx.saved_tensors
        by_x, by_mu = ctx.needs_input_grad[:2]
        adjoint = ctx.projector.T

        def gradients(images: Tensor) -> tuple[Tensor | None, Tensor | None]:
            return adjoint._run(images) if by_x else None, adjoint._mu_gradient(images, x) if by_mu else None

        return *_once(gradients, gradient, x, mu), None, None


def trace_rays(volume: Any, sources: Any, targets: Any, mu: Any, tracer: Tracer) -> Tensor:
    """Line integrals (N,) along rays from `sources` to `targets`, as a step of torch's graph.

    One of the four at least is a tensor; the others may be arrays. `volume` and `mu` have been checked, and are both
    tensors or both arrays; `mu` may be None.
    """
    starts, ends = _numbers(sources, points, "sources"), _numbers(targets, points, "targets")
    n = fitting_count(len(starts), len(ends))
    rays = torch.stack([starts.expand(n, 3), ends.expand(n, 3)])
    integrals = _Trace.apply(volume, mu, rays, lambda rays: [Ends(*rays)], tracer)
    return _of_kind(integrals.reshape(n), volume, sources, targets)


def trace_fans(volume: Any, vectors: Any, shape: tuple[int, int], mu: Any, tracer: Tracer) -> Tensor:
    """Line integrals (..., lines, rays) along the fans of `vectors` (..., 4, 3), likewise."""
    numbers = _numbers(vectors, fan_vectors, "vectors")
    integrals = _Trace.apply(volume, mu, numbers, lambda vectors: fans(vectors, shape), tracer)
    return _of_kind(integrals.reshape(*numbers.shape[:-2], *shape), volume, vectors)


def _numbers(value: Any, checked: Callable[[Any, str], NDArray[np.float64]], name: str) -> Tensor:
    """`value`, which is `checked`, as a tensor of float64 on the CPU, where rays are made; still in its graph."""
    if not isinstance(value, Tensor):
        return torch.from_numpy(checked(value, name))
    require_numbers(value, name)
    value = value.to("cpu", torch.float64)
    return value.reshape(checked(value.numpy(force=True), name).shape)


def _of_kind(integrals: Tensor, volume: Any, *geometry: Any) -> Tensor:
    """`integrals` of the type of the geometry's tensors, or else of the volume, on the device of the first tensor."""
    given = [x for x in (volume, *geometry) if isinstance(x, Tensor)]
    kinds = [x.dtype for x in geometry if isinstance(x, Tensor) and x.is_floating_point()]
    kind = functools.reduce(torch.promote_types, kinds or [given[0].dtype])
    return integrals.to(given[0].device, kind if kind.is_floating_point else torch.float64)


class _Trace(torch.autograd.Function):
    """Line integrals of a volume along bundles of rays; their derivatives by the geometry are computed on the way.

    ``bundles(geometry)`` makes the rays of an array (bundles, ...), of which the gradient by each bundle is of the shape.
    """

    @staticmethod
    def forward(ctx: Any, volume: Any, mu: Any, geometry: Tensor, bundles: Bundles, tracer: Tracer) -> Tensor:
        ctx.tracer, ctx.rays, ctx.derivatives = tracer, bundles(geometry.numpy(force=True)), None
        ctx.save_for_backward(geometry, *(x for x in (volume, mu) if isinstance(x, Tensor)))
        if ctx.needs_input_grad[2]:
            integrals, ctx.derivatives = tracer.derivatives(volume, ctx.rays, mu)
        else:
            integrals = tracer.integrals(volume, ctx.rays, mu)
        return torch.from_numpy(integrals)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        geometry, *fields = ctx.saved_tensors
        by_volume, by_mu, by_geometry = ctx.needs_input_grad[:3]
        tracer, rays, derivatives = ctx.tracer, ctx.rays, ctx.derivatives

        def gradients(gradient: Tensor) -> list[Tensor | None]:
            result: list[Tensor | None] = [None, None, None]
            if by_volume or by_mu:
                values = gradient.to(fields[0])  # the torch backend spreads on the device of the values
                if by_volume:
                    result[0] = torch.as_tensor(tracer.adjoint(values, rays, *fields[1:])).to(values)
                if by_mu:
                    result[1] = torch.as_tensor(tracer.mu_gradient(values, rays, *fields)).to(values)
            if by_geometry:
                of_bundles = tracer.gradients(gradient.numpy(force=True), derivatives, rays)
                result[2] = torch.from_numpy(np.asarray(of_bundles)).reshape(geometry.shape)
            return result

        return *_once(gradients, gradient, geometry, *fields), None, None


def _once(gradients: Gradients, gradient: Tensor, *seen: Tensor) -> Any:
    """``gradients(gradient)``, some of them None. They have no gradients themselves.

    What the forward step has `seen` stands in their graph, so that such a gradient is refused, not 0.
    """
    return _Once.apply(gradients, gradient, *seen)


class _Once(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradients: Gradients, gradient: Tensor, *seen: Tensor) -> Any:
        return tuple(gradients(gradient))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> None:
        raise InputError("gradients of these gradients are not available; leave create_graph=True out")
