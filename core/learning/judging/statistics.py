"""Confidence intervals for a few events or sites: ratios, differences, proportions, areas under curves."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError
from ...validation import real_array

Z95 = 1.959963984540054
"""Half-width in standard deviations of the central 95 % of a normal distribution."""
_RESAMPLES = 4000
_STEPS = 60  # steps of bisection, down to the last digit of a number from 0 to 1


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def ratio_of_means(values: ArrayLike, references: ArrayLike, seed: int = 0) -> Estimate:
    """Return the mean of `values` divided by the mean of `references`, both (n,) of the same events, with its interval.

    The interval is that of a paired bootstrap by percentiles (Efron, Tibshirani 1993, An Introduction to the Bootstrap,
    chapter 13). The same seed gives the same interval.
    """
    return _bootstrap(values, references, np.divide, seed)


def difference_of_means(values: ArrayLike, references: ArrayLike, seed: int = 0) -> Estimate:
    """Return the mean of `values` minus the mean of `references` (n,), with its paired bootstrap interval.

    Both arrays are of the same events in the same order.
    """
    return _bootstrap(values, references, np.subtract, seed)


def _bootstrap(values: ArrayLike, references: ArrayLike, compare: Callable[..., Floats], seed: int) -> Estimate:
    """Return the comparison ``compare(mean of values, mean of references)`` with its paired bootstrap interval."""
    size = np.size(values)
    pairs = np.stack([real_array(values, "values", (None,)), real_array(references, "other values", (size,))])
    if not pairs.size:
        raise InputError("bootstrap: expected values of one event or more, got none")
    n = pairs.shape[1]
    weights = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), _RESAMPLES) / n
    low, high = np.percentile(compare(*(pairs @ weights.T)), [2.5, 97.5])
    return Estimate(float(compare(*pairs.mean(axis=1))), float(low), float(high))


def wilson(successes: int, trials: int) -> Estimate:
    """Return the proportion of successes with Wilson's interval; NaN with the interval 0 to 1 without trials.

    E. B. Wilson 1927, "Probable inference, the law of succession, and statistical inference", J. Am. Stat. Assoc. 22.
    """
    if not trials:
        return Estimate(math.nan, 0.0, 1.0)
    share, z2 = successes / trials, Z95**2 / trials
    half = Z95 * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials))
    low, high = ((share + z2 / 2 + sign * half) / (1 + z2) for sign in (-1, 1))
    return Estimate(share, max(0.0, low), min(1.0, high))


def area_under_curve(absent: ArrayLike, present: ArrayLike) -> Estimate:
    """Return the probability that a rating with the signal exceeds one without it, ties by half, with its interval.

    The interval is that of Newcombe 2006, "Confidence intervals for an effect size measure based on the Mann-Whitney
    statistic. Part 2", Stat. Med. 25, method 5, whose variance is Hanley and McNeil's (1982) for exponential ratings: it
    stays within 0 and 1 and has a width even where all ratings are in order.
    """
    negatives, positives = np.sort(real_array(absent, "ratings", (None,))), real_array(present, "ratings", (None,))
    m, n = len(negatives), len(positives)
    if not m or not n:
        raise InputError(f"AUC: expected ratings with and without the signal, got {n} and {m}")
    below = (np.searchsorted(negatives, positives, "left") + np.searchsorted(negatives, positives, "right")) / 2
    area = float(below.mean()) / m

    def deviation(theta: float) -> float:
        """Return the standard deviation of the area if its true value is theta."""
        correlation = ((m + n) / 2 - 1) * ((1 - theta) / (2 - theta) + theta / (1 + theta))
        return math.sqrt(theta * (1 - theta) * (1 + correlation) / (m * n))

    def interval_end(outside: float) -> float:
        """Return the value towards `outside`, 0 or 1, from which the area is 1.96 standard deviations away."""
        inside = area
        for _ in range(_STEPS):
            theta = (inside + outside) / 2
            if abs(theta - area) <= Z95 * deviation(theta):
                inside = theta
            else:
                outside = theta
        return inside

    return Estimate(area, interval_end(0.0), interval_end(1.0))
