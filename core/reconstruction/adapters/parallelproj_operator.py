"""Projector with the methods of parallelproj's linear operators; parallelproj itself is not imported (duck typing)."""

import math
from typing import Any, Self

import numpy as np

from ...arrays import ArrayOrTensor
from ...rays.linear_operator import LinearOperator
from ...validation import real_array


class ParallelprojOperator:
    """Projector with parallelproj's names: ``op(x)``, ``op.apply(x)``, ``op.adjoint(y)``, ``op.H``, ``op.norm()``.

    Attributes
    ----------
    in_shape, out_shape : tuple
        Shapes of the arrays that ``op`` takes and returns.
    """

    def __init__(self, A: LinearOperator, scale: float = 1.0) -> None:
        self._operator, self.in_shape, self.out_shape = A, A.shape_in, A.shape_out
        self.scale = scale

    @property
    def scale(self) -> float:
        """Factor of the operator and its adjoint."""
        return self._scale

    @scale.setter
    def scale(self, value: float) -> None:
        self._scale = float(real_array(value, "parallelproj_operator: scale", ()))

    @property
    def H(self) -> Self:
        """Adjoint operator, with the same factor."""
        return type(self)(self._operator.T, self.scale)

    def apply(self, x: ArrayOrTensor) -> ArrayOrTensor:
        """Return ``scale * A(x)`` for an array or tensor."""
        result = self._operator(x)
        return result if self.scale == 1 else self.scale * result

    __call__ = apply

    def adjoint(self, y: ArrayOrTensor) -> ArrayOrTensor:
        """Return ``scale * A.T(y)`` for an array or tensor."""
        return self.H.apply(y)

    def adjointness_test(self, xp: Any = np, dev: Any = None, verbose: bool = False, **tolerances: Any) -> bool:
        """Return whether <A x, y> and <x, A.T y> are close (`numpy.isclose`) for random x and y.

        `xp` is the array library and `dev` the device of x and y; `tolerances` are arguments of `numpy.isclose`.
        """
        x, y = (_random(shape, xp, dev) for shape in (self.in_shape, self.out_shape))
        forward, back = float(xp.sum(self.apply(x) * y)), float(xp.sum(x * self.adjoint(y)))
        if verbose:
            print(forward, back)
        return bool(np.isclose(forward, back, **tolerances))

    def norm(self, xp: Any = np, dev: Any = None, num_iter: int = 30) -> float:
        """Return the largest singular value, estimated by `num_iter` power iterations."""
        x = _random(self.in_shape, xp, dev)
        eigenvalue = 0.0  # of A.T A
        for _ in range(num_iter):
            x = self.adjoint(self.apply(x))
            if (eigenvalue := math.sqrt(float(xp.sum(x * x)))) == 0:
                return 0.0
            x = x / eigenvalue
        return math.sqrt(eigenvalue)


def _random(shape: tuple[int, ...], xp: Any, dev: Any) -> ArrayOrTensor:
    """Return uniform random numbers as an array of the library `xp` on the device `dev`."""
    values = np.random.default_rng(0).random(shape, np.float32)
    return xp.asarray(values) if dev is None else xp.asarray(values, device=dev)
