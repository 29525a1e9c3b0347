"""Whether a volume explains the counts: Poisson deviance by what it is for the true means."""

from functools import cache

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError

_LEAST, _MANY = 1e-8, 50.0
"""Counts: fewer are expected nowhere, as a pixel that has counted must not say infinitely much; above, a series is exact
to 1e-5."""


def relative_deviance(counts: ArrayLike, expected: ArrayLike) -> float:
    """The deviance of counts from expected means, by its mean over all counts that these would give.

    The deviance is ``sum of 2 (y log(y / m) - y + m)``. A pixel of a large mean m gives 1 on average, one of 0.1 only 0.46:
    for so few counts its exact mean is taken instead of the number of pixels. Hence 1 is right at any number of counts, for
    the true means; the maximum of the likelihood lies below, as it explains some of the noise, too.

    McCullagh, Nelder 1989, Generalized Linear Models, section 2.3.
    """
    y, mean = (np.asarray(values, np.float64) for values in (counts, expected))
    if y.shape != mean.shape or not y.size:
        raise InputError(f"deviance: expected counts and means of the same shape, got {y.shape} and {mean.shape}")
    mean = np.maximum(mean, _LEAST)
    return float(_deviance(y, mean).sum() / expected_deviance(mean).sum())


def expected_deviance(mean: ArrayLike) -> Floats:
    """The mean deviance of Poisson counts of each mean, to 1e-4 of it."""
    means = np.maximum(np.asarray(mean, np.float64), _LEAST)
    known, values = _table()
    few = np.exp(np.interp(np.log(means), known, values))
    many = 1 + 1 / (6 * means) + 1 / (6 * means**2)
    return np.where(means < _MANY, few, many)


def _deviance(y: Floats, mean: Floats) -> Floats:
    logs = np.log(np.where(y > 0, y / mean, 1.0))
    return 2 * (y * logs - y + mean)


@cache
def _table() -> tuple[Floats, Floats]:
    """Logarithms of means and of their mean deviances."""
    means = np.geomspace(_LEAST, _MANY, 1200)
    y = np.arange(1 + int(_MANY + 12 * np.sqrt(_MANY)))
    factorials = np.concatenate([[0.0], np.cumsum(np.log(y[1:]))])
    chances = np.exp(y * np.log(means)[:, None] - means[:, None] - factorials)
    return np.log(means), np.log((chances * _deviance(y.astype(float), means[:, None])).sum(axis=1))
