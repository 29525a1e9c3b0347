"""Counts with an additive background: their log-likelihood, and checks of what a reconstruction is given."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..projector import Projector
from ..validation import real_array
from ..volumes.volume import Volume

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class CountData:
    """Measured counts (M, n_v, n_u) and the background, of the same shape, that is in them besides the volume's."""

    counts: Array
    background: Array

    @classmethod
    def of(cls, A: Projector, counts: ArrayLike, background: ArrayLike = 0.0) -> "CountData":
        """Checked: counts and background are at least 0, of the projector's shape.

        The background is one number, one for each module (M,), or images; that of the projector's model is added to it.
        Raises InputError.
        """
        if not isinstance(A, Projector):
            raise InputError(f"reconstruction: expected a Projector, got {type(A).__name__}")
        measured = real_array(counts, "counts", A.shape_out, np.float32)
        if measured.min() < 0:
            raise InputError(f"counts: expected 0 or more, got {measured.min():g}")
        extra = np.asarray(background, dtype=np.float32)
        if extra.shape == A.shape_out[:1]:
            extra = extra[:, None, None]
        elif extra.shape not in ((), A.shape_out):
            shapes = f"one number, {A.shape_out[0]} numbers or images of {' x '.join(map(str, A.shape_out))}"
            raise InputError(f"background: expected {shapes}, got {' x '.join(map(str, extra.shape))}")
        if not np.isfinite(extra).all() or extra.min(initial=0.0) < 0:
            raise InputError("background: expected finite numbers, 0 or more")
        return cls(measured, np.broadcast_to(extra + A.background.astype(np.float32), A.shape_out))

    def __getitem__(self, which: NDArray[np.int64]) -> "CountData":
        return CountData(self.counts[which], self.background[which])

    def ratio(self, images: Array) -> Array:
        """Measured by expected counts, where a volume's are `images`; 0 where neither is above 0.

        A pixel that counted something which nothing can have caused is left out: it says nothing about the volume.
        """
        expected = images + self.background
        return np.divide(self.counts, expected, out=np.zeros_like(expected), where=expected > 0)

    def log_likelihood(self, images: Array) -> float:
        """Of the counts (Poisson) where a volume's images are `images`, without the terms that no volume changes.

        Pixels with counts that nothing can have caused are left out, as in `ratio`.
        """
        expected = images.astype(np.float64) + self.background
        possible = expected > 0
        logs = np.log(expected, out=np.zeros_like(expected), where=possible)
        return float(np.sum(self.counts * logs) - expected.sum())


def starting_values(A: Projector, start: Volume | ArrayLike | None, mask: ArrayLike | None) -> Array:
    """The values that an algorithm begins with, float32: those of `start`, or 1; 0 outside `mask`. Raises InputError."""
    if start is None:
        values = np.ones(A.shape_in, np.float32)
    else:
        array = A._check(start) if isinstance(start, Volume) else start
        values = real_array(array, "start", A.shape_in, np.float32)
        if values.min() < 0:
            raise InputError(f"start: expected 0 or more, got {values.min():g}")
    if mask is not None:
        inside = np.asarray(mask)
        if inside.shape != A.shape_in or inside.dtype != bool:
            raise InputError(f"mask: expected booleans of shape {' x '.join(map(str, A.shape_in))}")
        values[~inside] = 0.0
    return values
