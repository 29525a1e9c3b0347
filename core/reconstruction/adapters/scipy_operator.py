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
        """Return the images of the volumes in the columns of X, as columns; they are computed as one batch."""
        n = X.shape[1]
        result: Array = self._operator(X.T.reshape(n, *self._operator.shape_in))
        return result.reshape(n, -1).T

    def _adjoint(self) -> "ScipyOperator":
        """Return the adjoint, from flat images to flat volumes."""
        return ScipyOperator(self._operator.T)
