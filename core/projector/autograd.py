"""Gradients in torch, whatever the backend: of the operators, and of rays traced one by one."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import InputError
from .tracing import fitting_count, points

if TYPE_CHECKING:
    from ..progress import Progress
    from .operator import LinearOperator
    from .tracing import Tracer


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


def trace(volume: Any, sources: Any, targets: Any, tracer: Tracer) -> Tensor:
    """Line integrals (N,) along rays from `sources` to `targets`, as a step of torch's graph.

    One of the three at least is a tensor; the others may be arrays. `volume` has been checked.
    """
    given = [x for x in (volume, sources, targets) if isinstance(x, Tensor)]
    kinds = [x.dtype for x in (sources, targets) if isinstance(x, Tensor) and x.is_floating_point()]
    starts, ends = _points(sources, "sources"), _points(targets, "targets")
    n = fitting_count(len(starts), len(ends))
    result: Tensor = _Trace.apply(volume, starts.expand(n, 3), ends.expand(n, 3), tracer)
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
    def forward(ctx: Any, volume: Any, starts: Tensor, ends: Tensor, tracer: Tracer) -> Tensor:
        ctx.tracer = tracer
        ctx.save_for_backward(*(x for x in (volume, starts, ends) if isinstance(x, Tensor)))
        rays = starts.numpy(force=True), ends.numpy(force=True)
        ctx.slopes = None
        if any(ctx.needs_input_grad[1:3]):
            integrals, *ctx.slopes = map(torch.from_numpy, tracer.derivatives(volume, *rays))
        else:
            integrals = torch.from_numpy(tracer.integrals(volume, *rays))
        return integrals

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        needs = ctx.needs_input_grad[:3]
        # What the forward step saw stands in the graph of the gradient, so that its derivative is refused, not 0.
        of_volume, of_starts, of_ends = _Once.apply(gradient, needs, ctx.slopes, ctx.tracer, *ctx.saved_tensors)
        return of_volume, of_starts, of_ends, None


class _Once(torch.autograd.Function):
    """The gradients of `_Trace` by volume, starts and ends, where needed; they have no gradients themselves."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, needs: Any, slopes: Any, tracer: Tracer, *saved: Tensor) -> Any:
        starts, ends = saved[-2:]
        of_volume = None
        if needs[0]:
            values = gradient.to(saved[0])  # the torch backend spreads on the device of the values
            spread = tracer.adjoint(values, starts.numpy(force=True), ends.numpy(force=True))
            of_volume = torch.as_tensor(spread).to(saved[0])
        of_ends = [gradient[:, None] * slopes[i] if needs[1 + i] else None for i in range(2)]
        return of_volume, *of_ends

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> None:
        raise InputError("trace_rays: gradients of its gradients are not available; leave create_graph=True out")
