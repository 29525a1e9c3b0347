"""Steps in torch's graph, made of plain functions."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import InputError

Gradients = Callable[[Tensor, Sequence[bool]], Sequence[Tensor | None]]


def linear(forward: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """``forward(x)``, a linear map with that `adjoint`; differentiable to any order, in both modes."""
    return _Linear.apply(forward, adjoint, x)


class _Linear(torch.autograd.Function):
    """The derivative of a linear map is itself, and its gradient the adjoint's."""

    @staticmethod
    def forward(ctx: Any, forward: Any, adjoint: Any, x: Tensor) -> Tensor:
        ctx.maps = forward, adjoint
        return forward(x.detach())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None, Tensor]:
        forward, adjoint = ctx.maps
        return None, None, linear(adjoint, forward, gradient)

    @staticmethod
    def jvp(ctx: Any, _forward: None, _adjoint: None, tangent: Tensor) -> Tensor:
        forward, adjoint = ctx.maps
        return linear(forward, adjoint, tangent)


def step(run: Callable[[Sequence[bool]], tuple[Tensor, Gradients]], *inputs: Any) -> Tensor:
    """A result that depends on `inputs`, some of them tensors, with its gradients; these have no gradients themselves.

    Parameters
    ----------
    run
        Takes which inputs need a gradient, and returns the result and another function: that takes the result's gradient
        and which inputs need one, and returns their gradients, None for the others.
    """
    return _Step.apply(run, *inputs)


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, run: Any, *inputs: Any) -> Tensor:
        result, ctx.gradients = run(ctx.needs_input_grad[1:])
        ctx.save_for_backward(*(x for x in inputs if isinstance(x, Tensor)))
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        needs = ctx.needs_input_grad[1:]
        return None, *_Once.apply(ctx.gradients, needs, gradient, *ctx.saved_tensors)


class _Once(torch.autograd.Function):
    """Gradients that depend on all inputs of the step: a gradient of them is refused, where it would be wrongly 0."""

    @staticmethod
    def forward(ctx: Any, gradients: Gradients, needs: Sequence[bool], gradient: Tensor, *inputs: Tensor) -> Any:
        return tuple(gradients(gradient, needs))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> None:
        raise InputError("gradients of these gradients are not available; leave create_graph=True out")
