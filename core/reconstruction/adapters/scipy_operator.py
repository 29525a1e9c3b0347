"""scipy's linear operators."""

import numpy as np
from scipy.sparse.linalg import LinearOperator as ScipyLinearOperator

from ...arrays import Array
from ...rays.linear_operator import LinearOperator


class ScipyOperator(ScipyLinearOperator):
    """A projector between flat arrays."""

    def __init__(self, A: LinearOperator) -> None:
        self._operator = A
        super().__init__(np.dtype(np.float32), (int(np.prod(A.shape_out)), int(np.prod(A.shape_in))))

    def _matmat(self, X: Array) -> Array:
        return _of_columns(self._operator, X)

    def _rmatmat(self, X: Array) -> Array:
        return _of_columns(self._operator.T, X)

    def _matvec(self, x: Array) -> Array:
        return self._matmat(x.reshape(-1, 1))[:, 0]

    def _rmatvec(self, x: Array) -> Array:
        return self._rmatmat(x.reshape(-1, 1))[:, 0]


def _of_columns(A: LinearOperator, columns: Array) -> Array:
    """Apply `A` to each column, as one batch."""
    n = columns.shape[1]
    result: Array = A(columns.T.reshape(n, *A.shape_in))
    return result.reshape(n, -1).T
