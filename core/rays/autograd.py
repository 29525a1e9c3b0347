"""Steps of torch's graph, made of plain functions."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import InputError

Gradients = Callable[[Tensor, Sequence[bool]], Sequence[Tensor | None]]


def linear(forward: Callable[[Tensor], Tensor], adjoint: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Return ``forward(x)``, a linear map with that `adjoint`; differentiable to any order, in both modes.

    Both maps take a batch, axes before those of `x`.
    """
    return _Linear.apply(forward, adjoint, x)


class _Linear(torch.autograd.Function):
    """Linear map as a step: its derivative is the map itself, its gradient the adjoint, a batch that of torch.func.vmap."""

    @staticmethod
    def forward(forward: Any, adjoint: Any, x: Tensor) -> Tensor:
        return forward(x.detach())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.maps = inputs[:2]

    @staticmethod
    def vmap(_info: Any, in_dims: tuple[Any, ...], forward: Any, adjoint: Any, x: Tensor) -> tuple[Tensor, int]:
        return linear(forward, adjoint, x.movedim(in_dims[2], 0)), 0

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None, Tensor]:
        forward, adjoint = ctx.maps
        return None, None, linear(adjoint, forward, gradient)

    @staticmethod
    def jvp(ctx: Any, _forward: None, _adjoint: None, tangent: Tensor) -> Tensor:
        forward, adjoint = ctx.maps
        return linear(forward, adjoint, tangent)


def step(run: Callable[[Sequence[bool]], tuple[Tensor, Gradients]], *inputs: Any) -> Tensor:
    """Return a result that depends on `inputs`, some of them tensors, and is differentiable once by them.

    Parameters
    ----------
    run
        Function of a sequence that tells which inputs need a gradient. It returns the result and a function of the result's
        gradient and of such a sequence, which returns the inputs' gradients, None for the other inputs.
    """
    return _Step.apply(run, *inputs)


class _Step(torch.autograd.Function):
    """Plain function with gradients as a step."""

    @staticmethod
    def forward(ctx: Any, run: Any, *inputs: Any) -> Tensor:
        result, ctx.gradients = run(ctx.needs_input_grad[1:])
        ctx.save_for_backward(*(x for x in inputs if isinstance(x, Tensor)))
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_Once.apply(ctx.gradients, ctx.needs_input_grad[1:], gradient, *ctx.saved_tensors)


class _Once(torch.autograd.Function):
    """Gradients of a step, as a step that depends on all its inputs: their own gradient is refused, and not wrongly 0."""

    @staticmethod
    def forward(ctx: Any, gradients: Gradients, needs: Sequence[bool], gradient: Tensor, *inputs: Tensor) -> Any:
        return tuple(gradients(gradient, needs))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> None:
        raise InputError("gradients of these gradients are not available; leave create_graph=True out")
