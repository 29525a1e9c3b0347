"""Counts with an additive background: their log-likelihood, and checks of what a reconstruction is given."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, warn
from ..geometry.frames import affine_matrix
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..projector import Emission, Projector
from ..validation import instance, real_array, shape_text
from .loop import plain
from .priors import Prior
from .result import Array

# Less is nothing: float32 could not hold what it would be divided into.
LEAST = np.float32(1e-30)

_SURE, _SURE_SHARE = 30.0, 0.015
"""Log-likelihood that chance does not give, and, as a share of the counts, that a coarse model does not."""


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
        known = A.background.astype(np.float32)
        if extra.any() and known.any():
            both = f"{extra.mean():.3g} counts a pixel, besides the {known.mean():.3g} of the projector's model"
            warn(f"background: {both}: both are expected; leave one out if they are the same")
        data = cls(measured, np.broadcast_to(extra + known, A.shape_out))
        if isinstance(A.model, Emission) and len(A.views) > 3:  # two or three tell too little
            _warn_if_reversed(A, A.model.system, data)
        return data

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


def _warn_if_reversed(A: Projector, system: PinholeSystem, data: CountData) -> None:
    """Warn where the counts are far likelier of the modules in reversed order: by a step of MLEM on few, large voxels."""
    chosen = np.unique(np.rint(np.linspace(0, len(system) - 1, min(len(system), 16))).astype(int))  # symmetric
    shape = np.minimum(A.grid.shape, 20)
    step = A.grid.shape / shape
    grid = Grid(tuple(shape), A.grid.affine @ affine_matrix(np.diag(step), (step - 1) / 2))
    B = Projector(grid, A.views[chosen], Emission(system[chosen], pixel_points=1, tolerance=1e9), A.backend, A.threads)
    part, seen = data[chosen], np.maximum(B.T(np.ones(B.shape_out, np.float32)), LEAST)
    total, likelihoods = float(part.counts.sum(dtype=float)), []
    even = np.full(shape, total / seen.sum(dtype=float), np.float32)
    everywhere = part.background + np.float32(0.01 * total / part.counts.size)  # also where B expects nothing
    for data in (CountData(part.counts, everywhere), CountData(part.counts[::-1], everywhere)):
        likelihoods.append(data.log_likelihood(B(even / seen * B.T(data.ratio(B(even))))))
    if (gain := likelihoods[1] - likelihoods[0]) > max(_SURE, _SURE_SHARE * total):
        said = f"(log-likelihood {gain:.4g} higher, {total:.4g} counts of {len(chosen)} modules)"
        warn(f"counts: likelier of the modules in reversed order {said}: are both in the same order?", 4)


def _require_none_below_0(numbers: Array, name: str) -> None:
    if numbers.min(initial=0.0) < 0:
        index = np.unravel_index(numbers.argmin(), numbers.shape)
        where = f" at index {tuple(int(i) for i in index)}" if index else ""
        raise InputError(f"{name}: expected 0 or more, got {numbers.min():g}{where}")
