"""Intervals of what a few events or sites say: ratios, differences, shares and areas under curves."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError
from ...validation import real_array

Z95 = 1.959963984540054
"""How many standard deviations of a normal distribution hold 95 % of it."""
_RESAMPLES = 4000
_STEPS = 60  # of bisection: down to the last digit of a number from 0 to 1


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


def ratio_of_means(values: ArrayLike, others: ArrayLike, seed: int = 0) -> Estimate:
    """The mean of `values` by that of `others`, both (n,) of the same events: paired bootstrap, percentiles.

    Efron, Tibshirani 1993, An Introduction to the Bootstrap, chapter 13. The same seed gives the same interval.
    """
    return _bootstrap(values, others, np.divide, seed)


def difference_of_means(values: ArrayLike, others: ArrayLike, seed: int = 0) -> Estimate:
    """The mean of `values` minus that of `others`, as in `ratio_of_means`."""
    return _bootstrap(values, others, np.subtract, seed)


def _bootstrap(values: ArrayLike, others: ArrayLike, compare: Callable[..., Floats], seed: int) -> Estimate:
    both = np.stack([real_array(values, "values", (None,)), real_array(others, "other values", (np.size(values),))])
    if not both.size:
        raise InputError("bootstrap: expected values of one event or more, got none")
    n = both.shape[1]
    shares = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), _RESAMPLES) / n
    low, high = np.percentile(compare(*(both @ shares.T)), [2.5, 97.5])
    return Estimate(float(compare(*both.mean(axis=1))), float(low), float(high))


def wilson(successes: int, trials: int) -> Estimate:
    """The share of trials that succeed, with Wilson's interval; of no trials NaN, from 0 to 1.

    E. B. Wilson 1927, "Probable inference, the law of succession, and statistical inference", J. Am. Stat. Assoc. 22.
    """
    if not trials:
        return Estimate(math.nan, 0.0, 1.0)
    share, z2 = successes / trials, Z95**2 / trials
    half = Z95 * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials))
    low, high = ((share + z2 / 2 + sign * half) / (1 + z2) for sign in (-1, 1))
    return Estimate(share, max(0.0, low), min(1.0, high))


def area_under_curve(absent: ArrayLike, present: ArrayLike) -> Estimate:
    """The chance that a rating of a signal that is present exceeds one where it is absent; ties count half.

    The interval is that of Newcombe 2006, "Confidence intervals for an effect size measure based on the Mann-Whitney
    statistic. Part 2", Stat. Med. 25, method 5, whose variance is Hanley and McNeil's (1982) for exponential ratings: it
    stays within 0 and 1 and has a width even where all ratings are in order.
    """
    without, having = np.sort(real_array(absent, "ratings", (None,))), real_array(present, "ratings", (None,))
    m, n = len(without), len(having)
    if not m or not n:
        raise InputError(f"AUC: expected ratings with and without the signal, got {n} and {m}")
    below = (np.searchsorted(without, having, "left") + np.searchsorted(without, having, "right")) / 2
    area = float(below.mean()) / m

    def deviation(theta: float) -> float:
        spread = ((m + n) / 2 - 1) * ((1 - theta) / (2 - theta) + theta / (1 + theta))
        return math.sqrt(theta * (1 - theta) * (1 + spread) / (m * n))

    def end(outside: float) -> float:
        inside = area
        for _ in range(_STEPS):  # the farthest value from which the area is no more than 1.96 deviations away
            middle = (inside + outside) / 2
            if abs(middle - area) <= Z95 * deviation(middle):
                inside = middle
            else:
                outside = middle
        return inside

    return Estimate(area, end(0.0), end(1.0))
