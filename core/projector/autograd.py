"""Gradients in torch, whatever the backend: of the operators, and of rays traced one by one."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import InputError
from .tracing import fitting_count, points

if TYPE_CHECKING:
    from ..progress import Progress
    from .operator import LinearOperator, Projector
    from .tracing import Tracer

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


def trace(volume: Any, sources: Any, targets: Any, mu: Any, tracer: Tracer) -> Tensor:
    """Line integrals (N,) along rays from `sources` to `targets`, as a step of torch's graph.

    One of the four at least is a tensor; the others may be arrays. `volume` and `mu` have been checked, and are both
    tensors or both arrays; `mu` may be None.
    """
    given = [x for x in (volume, sources, targets) if isinstance(x, Tensor)]
    kinds = [x.dtype for x in (sources, targets) if isinstance(x, Tensor) and x.is_floating_point()]
    starts, ends = _points(sources, "sources"), _points(targets, "targets")
    n = fitting_count(len(starts), len(ends))
    result: Tensor = _Trace.apply(volume, mu, starts.expand(n, 3), ends.expand(n, 3), tracer)
    kind = functools.reduce(torch.promote_types, kinds or [given[0].dtype])
    return result.to(given[0].device, kind if kind.is_floating_point else torch.float64)


def _points(value: Any, name: str) -> Tensor:
    """`value` as a tensor (n, 3) of float64 on the CPU, where rays are made; still in its graph."""
    if not isinstance(value, Tensor):
        return torch.from_numpy(points(value, name))
    points(value.detach().cpu().numpy() if not value.is_complex() else [1j], name)
    return value.to("cpu", torch.float64).reshape(-1, 3)


class _Trace(torch.autograd.Function):
    """Line integrals of a volume along rays; their derivatives by the ends are computed on the way."""

    @staticmethod
    def forward(ctx: Any, volume: Any, mu: Any, starts: Tensor, ends: Tensor, tracer: Tracer) -> Tensor:
        ctx.tracer = tracer
        ctx.save_for_backward(starts, ends, *(x for x in (volume, mu) if isinstance(x, Tensor)))
        rays = starts.numpy(force=True), ends.numpy(force=True)
        ctx.slopes = None, None
        if any(ctx.needs_input_grad[2:4]):
            integrals, *ctx.slopes = map(torch.from_numpy, tracer.derivatives(volume, *rays, mu))
        else:
            integrals = torch.from_numpy(tracer.integrals(volume, *rays, mu))
        return integrals

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        starts, ends, *fields = ctx.saved_tensors
        needs, tracer = ctx.needs_input_grad, ctx.tracer

        def gradients(gradient: Tensor) -> list[Tensor | None]:
            rays = starts.numpy(force=True), ends.numpy(force=True)
            of_fields: list[Tensor | None] = [None, None]
            if any(needs[:2]):
                values = gradient.to(fields[0])  # the torch backend spreads on the device of the values
                if needs[0]:
                    of_fields[0] = torch.as_tensor(tracer.adjoint(values, *rays, *fields[1:])).to(values)
                if needs[1]:
                    of_fields[1] = torch.as_tensor(tracer.mu_gradient(values, *rays, *fields)).to(values)
            slopes = zip(ctx.slopes, needs[2:4], strict=True)
            return of_fields + [gradient[:, None] * slope if need else None for slope, need in slopes]

        return *_once(gradients, gradient, starts, ends, *fields), None


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
