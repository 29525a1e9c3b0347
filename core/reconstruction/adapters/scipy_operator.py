"""Projector as a linear operator of scipy."""

import numpy as np
from scipy.sparse.linalg import LinearOperator as ScipyLinearOperator

from ...arrays import Array
from ...rays.linear_operator import LinearOperator


class ScipyOperator(ScipyLinearOperator):
    """Projector as a SciPy `LinearOperator`, from flat volumes to flat images in float32."""

    def __init__(self, A: LinearOperator) -> None:
        self._operator = A
        super().__init__(np.dtype(np.float32), (int(np.prod(A.shape_out)), int(np.prod(A.shape_in))))

    def _matmat(self, X: Array) -> Array:
        """Return the images of the volumes in the columns of X, as columns."""
        return _apply_to_columns(self._operator, X)

    def _rmatmat(self, X: Array) -> Array:
        """Return the adjoint of the images in the columns of X, as columns."""
        return _apply_to_columns(self._operator.T, X)

    def _rmatvec(self, x: Array) -> Array:
        """Return the adjoint of flat images, flat."""
        return self._rmatmat(x.reshape(-1, 1))[:, 0]


def _apply_to_columns(A: LinearOperator, columns: Array) -> Array:
    """Return the matrix whose columns are `A` applied to each of `columns` (n_in, n), computed as one batch."""
    n = columns.shape[1]
    result: Array = A(columns.T.reshape(n, *A.shape_in))
    return result.reshape(n, -1).T
