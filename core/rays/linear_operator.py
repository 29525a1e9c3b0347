"""Linear operators and their adjoints."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, checked, is_tensor, is_transformed, uncompiled, zeros
from ..memory import require
from ..progress import Progress, part_of
from ..validation import shape_text
from ..volumes.volume import Volume


class LinearOperator(ABC):
    """Linear map ``A(x)`` with the exact adjoint ``A.T(y)``; differentiable in torch.

    Both take a batch: the axes before those of `shape_in` come before those of `shape_out`.
    """

    @uncompiled
    def __call__(self, x: Volume | ArrayOrTensor, progress: Progress | None = None) -> ArrayOrTensor:
        """Apply the operator.

        Parameters
        ----------
        x
            Numpy array or torch tensor (..., *shape_in); a projector also takes a `Volume`.
        progress
            Called as ``progress(views done, views)``, for a batch over all of it; an exception from it stops the work.

        Returns
        -------
        array or tensor (..., *shape_out)
            A tensor on the device of `x` if that is a tensor (part of torch's graph if it requires a
            gradient, for every backend), else a numpy array.

        Raises
        ------
        InputError
            The volume is on another grid, or more memory is needed than there is.
        """
        return self._apply(x if is_transformed(x) else self._check(x), progress)

    def _apply(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Apply to a checked array or tensor, or one of torch.func, with its gradient in torch but not that of mu."""
        if not is_tensor(x):
            return self._run(x, progress, mu)
        from .autograd import linear

        check = self._check if is_transformed(x) else lambda x: x
        return linear(lambda x: self._run(check(x), progress, mu), lambda y: self.T._run(y, mu=mu), x)

    _names = ("array", "array")  # names in messages of the argument, and of the adjoint's argument
    _float64 = False  # whether it computes in float64 also from float32

    @functools.cached_property
    def T(self) -> LinearOperator:
        """Exact adjoint, <A x, y> = <x, A.T y>."""
        return Adjoint(self)

    @property
    @abstractmethod
    def shape_in(self) -> tuple[int, ...]:
        """Shape of the argument."""

    @property
    @abstractmethod
    def shape_out(self) -> tuple[int, ...]:
        """Shape of the result."""

    def _check(self, x: Any) -> ArrayOrTensor:
        """Return `x` as an array or tensor; raise `InputError` if it has another shape or is not finite."""
        return checked(x, self._names[0], self.shape_in, self._float64, batch=True)

    def _run(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Apply to a checked array or tensor, one by one to those of a batch, without recording a graph."""
        if not (batch := tuple(x.shape[: x.ndim - len(self.shape_in)])):
            return self._run_one(x, progress, mu)
        n = math.prod(batch)
        work = f"a batch of {n} times {shape_text(self.shape_out)} numbers"
        require(x.itemsize * n * math.prod(self.shape_out), work)
        results = zeros((*batch, *self.shape_out), x)
        for n_done, index in enumerate(np.ndindex(batch)):
            results[index] = self._run_one(x[index], part_of(progress, n_done, n), mu)
        return results

    @abstractmethod
    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Apply to an array or tensor of `shape_in`."""

    @abstractmethod
    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Apply the adjoint to an array or tensor of `shape_out`."""


class Adjoint(LinearOperator):
    """Adjoint of an operator, ``A.T``."""

    def __init__(self, operator: LinearOperator) -> None:
        self._operator = operator
        self._names = operator._names[::-1]
        self._float64 = operator._float64

    @property
    def T(self) -> LinearOperator:  # type: ignore[override]
        """Operator whose adjoint this is."""
        return self._operator

    @property
    def shape_in(self) -> tuple[int, ...]:
        """Shape of the argument, the operator's result."""
        return self._operator.shape_out

    @property
    def shape_out(self) -> tuple[int, ...]:
        """Shape of the result, the operator's argument."""
        return self._operator.shape_in

    def __repr__(self) -> str:
        return f"{self._operator!r}.T"

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Return the adjoint of the operator applied to `x`."""
        return self._operator._run_back(x, progress, mu)

    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: ArrayOrTensor = None) -> ArrayOrTensor:
        """Return the operator itself applied to `x`: the adjoint of the adjoint."""
        return self._operator._run_one(y, progress, mu)
