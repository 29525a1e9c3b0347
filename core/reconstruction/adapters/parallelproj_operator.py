"""The methods of parallelproj's linear operators, which are not imported: whatever has these methods is one."""

import math
from typing import Any, Self

import numpy as np

from ...arrays import ArrayOrTensor
from ...rays.linear_operator import LinearOperator
from ...validation import real_array


class ParallelprojOperator:
    """A projector with parallelproj's names: ``op(x)``, ``op.apply(x)``, ``op.adjoint(y)``, ``op.H``, ``op.norm()``.

    Attributes
    ----------
    in_shape, out_shape : tuple
        Shapes of what it takes and of what it gives.
    """

    def __init__(self, A: LinearOperator, scale: float = 1.0) -> None:
        self._operator, self.in_shape, self.out_shape = A, A.shape_in, A.shape_out
        self.scale = scale

    @property
    def scale(self) -> float:
        """A factor of the operator and its adjoint."""
        return self._scale

    @scale.setter
    def scale(self, value: float) -> None:
        self._scale = float(real_array(value, "parallelproj_operator: scale", ()))

    @property
    def H(self) -> Self:
        """The adjoint operator."""
        return type(self)(self._operator.T, self.scale)

    def apply(self, x: ArrayOrTensor) -> ArrayOrTensor:
        """Return ``scale * A(x)`` of an array or tensor."""
        result = self._operator(x)
        return result if self.scale == 1 else self.scale * result

    __call__ = apply

    def adjoint(self, y: ArrayOrTensor) -> ArrayOrTensor:
        """Return ``scale * A.T(y)`` of an array or tensor."""
        return self.H.apply(y)

    def adjointness_test(self, xp: Any = np, dev: Any = None, verbose: bool = False, **tolerances: Any) -> bool:
        """Return whether <A x, y> and <x, A.T y> are close (`numpy.isclose`) for random x, y of the array library `xp`."""
        x, y = (_random(shape, xp, dev) for shape in (self.in_shape, self.out_shape))
        forward, back = float(xp.sum(self.apply(x) * y)), float(xp.sum(x * self.adjoint(y)))
        if verbose:
            print(forward, back)
        return bool(np.isclose(forward, back, **tolerances))

    def norm(self, xp: Any = np, dev: Any = None, num_iter: int = 30) -> float:
        """Return the largest singular value, by power iterations."""
        x = _random(self.in_shape, xp, dev)
        squared = 0.0
        for _ in range(num_iter):
            x = self.adjoint(self.apply(x))
            squared = math.sqrt(float(xp.sum(x * x)))
            if squared == 0:
                return 0.0
            x = x / squared
        return math.sqrt(squared)


def _random(shape: tuple[int, ...], xp: Any, dev: Any) -> ArrayOrTensor:
    values = np.random.default_rng(0).random(shape, np.float32)
    return xp.asarray(values) if dev is None else xp.asarray(values, device=dev)
