"""Counts with an additive background: their log-likelihood, and checks of what a reconstruction is given."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..projector import Projector
from ..validation import instance, real_array, shape_text
from .loop import plain
from .priors import Prior
from .result import Array

# Less is nothing: float32 could not hold what it would be divided into.
LEAST = np.float32(1e-30)


@dataclass(frozen=True, eq=False)
class CountData:
    """Measured counts (M, n_v, n_u) and the background, of the same shape, that is in them besides the volume's."""

    counts: Array
    background: Array

    @classmethod
    def of(cls, method: str, A: Projector, counts: ArrayLike, background: ArrayLike = 0.0) -> "CountData":
        """Checked: `A` is of emission; counts and background are at least 0, of the projector's shape.

        The background is one number, one for each module (M,), or images; that of the projector's model is added to it.
        Raises InputError.
        """
        instance(A, Projector, method)
        if A.model.takes != ("activity",):
            raise InputError(f"{method}: expected a projector of emission, got one of {A.model.name}")
        measured = real_array(plain(counts), "counts", A.shape_out, np.float32)
        _require_none_below_0(measured, "counts")
        extra = real_array(plain(background), "background", None, np.float32)
        _require_none_below_0(extra, "background")
        if extra.shape == A.shape_out[:1]:
            extra = extra[:, None, None]
        elif extra.shape not in ((), A.shape_out):
            shapes = f"one number, {A.shape_out[0]} numbers or images of {shape_text(A.shape_out)}"
            raise InputError(f"background: expected {shapes}, got {shape_text(extra.shape)}")
        return cls(measured, np.broadcast_to(extra + A.background.astype(np.float32), A.shape_out))

    def __getitem__(self, which: NDArray[np.int64]) -> "CountData":
        return CountData(self.counts[which], self.background[which])

    def record(self, sensitivity: Array, prior: Prior | None) -> dict[str, Any]:
        """For a reconstruction's settings: totals, counts that one unit of activity in all voxels gives, and the prior."""
        sums = {"counts": self.counts, "background": self.background, "sensitivity": sensitivity}
        known = {name: float(numbers.sum(dtype=float)) for name, numbers in sums.items()}
        return known | ({"prior": None} if prior is None else prior.record())

    def ratio(self, images: Array) -> Array:
        """Measured by expected counts, where a volume's are `images`; 0 where neither is above 0.

        A pixel that counted something which nothing can have caused is left out: it says nothing about the volume.
        """
        expected = images + self.background
        return np.divide(self.counts, expected, out=np.zeros_like(expected), where=expected > LEAST)

    def log_likelihood(self, images: Array) -> float:
        """Of the counts (Poisson) where a volume's images are `images`, without the terms that no volume changes.

        Pixels with counts that nothing can have caused are left out, as in `ratio`.
        """
        expected = images.astype(np.float64) + self.background
        logs = np.log(expected, out=np.zeros_like(expected), where=expected > LEAST)
        return float(np.sum(self.counts * logs) - expected.sum())


def _require_none_below_0(numbers: Array, name: str) -> None:
    if numbers.min(initial=0.0) < 0:
        index = np.unravel_index(numbers.argmin(), numbers.shape)
        where = f" at index {tuple(int(i) for i in index)}" if index else ""
        raise InputError(f"{name}: expected 0 or more, got {numbers.min():g}{where}")
