"""Consistency of a volume with the counts: Poisson deviance relative to its mean for true means."""

from functools import cache

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError

_LEAST, _MANY = 1e-8, 50.0
"""Lower limit of expected counts, which keeps the deviance finite; counts above which a series is exact to 1e-5."""


def relative_deviance(counts: ArrayLike, expected: ArrayLike) -> float:
    """Return the deviance of counts from expected means, divided by its expected value for Poisson counts of these means.

    The deviance is ``sum of 2 (y log(y / m) - y + m)``. A pixel of a large mean m contributes 1 on average, one of 0.1 only
    0.46: for so few counts its exact mean is used instead of the number of pixels. Hence the result is 1 on average for the
    true means, at any number of counts; it is below 1 at the maximum of the likelihood, which explains some of the noise,
    too.

    McCullagh, Nelder 1989, Generalized Linear Models, section 2.3.
    """
    y, mean = (np.asarray(values, np.float64) for values in (counts, expected))
    if y.shape != mean.shape or not y.size:
        raise InputError(f"deviance: expected counts and means of the same shape, got {y.shape} and {mean.shape}")
    mean = np.maximum(mean, _LEAST)
    return float(_deviance(y, mean).sum() / expected_deviance(mean).sum())


def expected_deviance(mean: ArrayLike) -> Floats:
    """Return the mean deviance of Poisson counts of each mean, with a relative error of 1e-4."""
    means = np.maximum(np.asarray(mean, np.float64), _LEAST)
    log_means, values = _table()
    small = np.exp(np.interp(np.log(means), log_means, values))
    large = 1 + 1 / (6 * means) + 1 / (6 * means**2)
    return np.where(means < _MANY, small, large)


def _deviance(y: Floats, mean: Floats) -> Floats:
    """Return the deviance of each count from its mean."""
    logs = np.log(np.where(y > 0, y / mean, 1.0))
    return 2 * (y * logs - y + mean)


@cache
def _table() -> tuple[Floats, Floats]:
    """Return logarithms of means, and of their mean deviances, for interpolation."""
    means = np.geomspace(_LEAST, _MANY, 1200)
    y = np.arange(1 + int(_MANY + 12 * np.sqrt(_MANY)))
    factorials = np.concatenate([[0.0], np.cumsum(np.log(y[1:]))])
    probabilities = np.exp(y * np.log(means)[:, None] - means[:, None] - factorials)
    return np.log(means), np.log((probabilities * _deviance(y.astype(float), means[:, None])).sum(axis=1))
