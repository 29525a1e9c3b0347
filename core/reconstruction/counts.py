"""Counts with an additive background: their log-likelihood, checks of what a reconstruction is given, and its loop."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Integers
from ..errors import InputError, warn
from ..geometry.frames import affine_matrix
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress
from ..projector import Projector
from ..validation import instance, real_array, shape_text
from .loop import Loop, plain
from .priors import Prior, penalty_of

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
        """Check `A`, counts and background, and return them as data: counts and background >= 0, of the shape of the images.

        The background is one number, one for each module (M,), or images; that of the projector's model is added to it.
        Raises InputError. Pixels that are dead in the model are left out.
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
            warn(f"background: {both}: both are expected; leave one out if they are the same", 4)
        data = cls(measured, extra + known).living(A)
        if A.model.has_times and len(A.views) > 3:  # two or three say too little
            _warn_if_reversed(A, data)
        return data

    def living(self, A: Projector) -> "CountData":
        """Return the data with nothing in the pixels that are dead in a projector's model, which then say nothing."""
        return CountData(*(np.where(A.living, data, np.float32(0)) for data in (self.counts, self.background)))

    def __getitem__(self, which: Integers) -> "CountData":
        return CountData(self.counts[which], self.background[which])

    def ratio(self, images: Array) -> Array:
        """Return ``counts / (images + background)`` (M, n_v, n_u) for a volume with the expected counts `images`.

        A pixel that counted something which nothing can have caused is left out: it says nothing about the volume.
        """
        expected = images + self.background
        return np.divide(self.counts, expected, out=np.zeros_like(expected), where=expected > LEAST)

    def log_likelihood(self, images: Array) -> float:
        """Return ``sum(counts log(e) - e)``, e = images + background: the Poisson log-likelihood but for a constant.

        Pixels with counts that nothing can have caused are left out, as in `ratio`.
        """
        expected = images.astype(np.float64) + self.background
        logs = np.log(expected, out=np.zeros_like(expected), where=expected > LEAST)
        return float(np.sum(self.counts * logs) - expected.sum())


class CountLoop(Loop):
    """The iterations of a method for counts: a `Loop` that knows them, in subsets of the views, and the prior's penalty.

    Parameters
    ----------
    method, A, counts, iterations, prior, background
        See `mlem`.
    subsets : int, optional
        By default about a fifth of the views' number.
    options, named
        See `IterativeOptions`.

    Attributes
    ----------
    data : CountData
    parts : list of tuples
        Each subset's projector and counts.
    seen : list of arrays (n_x, n_y, n_z)
        Counts that one unit of activity in each voxel gives in each subset; `total` is their sum.
    visible : array of bool
        Voxels in the mask that some pixel sees.
    penalty : Penalty or None
    """

    def __init__(
        self,
        method: str,
        A: Projector,
        counts: ArrayLike,
        iterations: int,
        subsets: int | None,
        prior: Prior | None,
        background: ArrayLike,
        *options: Any,
        **named: Any,
    ) -> None:
        super().__init__(method, A, iterations, *options, **named)
        self.data = CountData.of(method, A, counts, background)
        parts = A.subsets(max(1, len(A.views) // 5) if subsets is None else subsets)
        self.parts = [(part, self.data[part.which]) for part in parts]
        require(4 * A.grid.n_voxels * len(parts), f"the sensitivities of {len(parts)} subsets")
        ones = ((part, np.ones(part.shape_out, np.float32)) for part, _ in self.parts)
        self.seen = [np.asarray(part.T(one, self.preparing()), np.float32) for part, one in ones]
        self.total: Array = sum(self.seen[1:], self.seen[0])
        self.visible = self.mask & (self.total > LEAST)
        self.prior, self.penalty = prior, penalty_of(prior, A.grid, self.visible)
        self._images: Array | None = None  # of the volume whose objective was asked for last
        self.last = -np.inf  # its objective

    def images(self, s: int, values: Array, progress: Progress | None) -> Array:
        """Return the images of a volume in subset `s`; those of the last iteration's volume are not computed again."""
        part, _ = self.parts[s]
        if values is self.values and self._images is not None:
            return self._images[part.which]
        return np.asarray(part(values, progress))

    def objective(self, values: Array, progress: Progress | None) -> float:
        """Return the log-likelihood of a volume minus the prior's penalty."""
        images: Array = self._A(values, progress)
        likelihood = self.data.log_likelihood(images)
        self._images = images
        self.last = likelihood if self.penalty is None else likelihood - self.penalty.value(values)
        return self.last

    def record(self) -> dict[str, Any]:
        """Return the number of subsets, the sums of counts, background and sensitivity, and the prior's settings."""
        sums = {"counts": self.data.counts, "background": self.data.background, "sensitivity": self.total}
        known = {name: float(numbers.sum(dtype=float)) for name, numbers in sums.items()}
        return {"subsets": len(self.parts), **known} | ({"prior": None} if self.prior is None else self.prior.record())


def _warn_if_reversed(A: Projector, data: CountData) -> None:
    """Warn where the counts are far likelier of the modules in reversed order: by a step of MLEM on few, large voxels."""
    chosen = np.unique(np.rint(np.linspace(0, len(A.views) - 1, min(len(A.views), 16))).astype(int))  # symmetric
    shape = np.minimum(A.grid.shape, 20)
    step = A.grid.shape / shape
    grid = Grid(tuple(shape), A.grid.affine @ affine_matrix(np.diag(step), (step - 1) / 2))
    B = Projector(grid, A.views[chosen], A.model.of_views(chosen).coarse(), A.backend, A.threads)
    part, seen = data[chosen], np.maximum(B.T(np.ones(B.shape_out, np.float32)), LEAST)
    total, likelihoods = float(part.counts.sum(dtype=float)), []
    even = np.full(shape, total / seen.sum(dtype=float), np.float32)
    everywhere = part.background + np.float32(0.01 * total / part.counts.size)  # also where B expects nothing
    for data in (CountData(part.counts, everywhere), CountData(part.counts[::-1], everywhere)):
        likelihoods.append(data.log_likelihood(B(even / seen * B.T(data.ratio(B(even))))))
    if (gain := likelihoods[1] - likelihoods[0]) > max(_SURE, _SURE_SHARE * total):
        found = f"(log-likelihood {gain:.4g} higher, {total:.4g} counts of {len(chosen)} modules)"
        warn(f"counts: likelier of the modules in reversed order {found}: are both in the same order?", 5)


def _require_none_below_0(numbers: Array, name: str) -> None:
    if numbers.min(initial=0.0) < 0:
        index = np.unravel_index(numbers.argmin(), numbers.shape)
        where = f" at index {tuple(int(i) for i in index)}" if index else ""
        raise InputError(f"{name}: expected 0 or more, got {numbers.min():g}{where}")
