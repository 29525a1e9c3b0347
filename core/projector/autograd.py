"""Gradients of the operators in torch, whatever their backend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from ..progress import Progress
    from .operator import LinearOperator


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
