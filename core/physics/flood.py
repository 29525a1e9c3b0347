"""Efficiencies of pixels from the image of an even source: what is left of a flood without its smooth trend."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Floats, Integers
from ..errors import InputError, warn
from ..validation import at_least_0, freeze, one_of, real_array

_SURE = 5.5
"""Standard deviations: chance gives them to one pixel in 5e7, to either side."""
_MILD = 2.0
"""Standard deviations from which on a pixel counts less for the trend (Cauchy)."""
_ROUNDS = 30
_FEWEST = 16  # counts: chance leaves a pixel of fewer empty too often
_LEAST_SHARE = 0.01
"""A module that counts less than this share of what others do is dead."""
_NORMAL = 1.4826  # standard deviations of a normal distribution in a median of absolute deviations


@dataclass(frozen=True, eq=False)
class FloodEfficiency:
    """What a flood says of the pixels of M modules; its text is one line of it."""

    efficiency: Floats
    """(M, n_v, n_u), of `Emission`: mean 1 over the living pixels of each module, 0 of dead and hot ones."""
    dead: Integers
    """(n, 3): module, row and column, from 0, of pixels that count too little in modules that live."""
    hot: Integers
    """(n, 3): of pixels that count too much, and are not to be trusted."""
    dead_modules: Integers
    """(n,): modules, from 0, that count nothing, or next to nothing."""
    spread: float
    """Relative standard deviation of the living pixels' efficiencies, without that of the counts."""

    def __str__(self) -> str:
        modules, rows, columns = self.efficiency.shape
        what = f"{len(self.dead)} dead and {len(self.hot)} hot pixels, {len(self.dead_modules)} dead modules"
        return f"{modules} modules of {columns} x {rows} pixels: {what}; others vary by {self.spread:.2%}"


def flood_efficiency(flood: ArrayLike, smooth_order: int = 2, spread: float = 0.05) -> FloodEfficiency:
    """The efficiencies of pixels, and which are dead or hot, from the image of an even source.

    In each module a polynomial of rows and columns, the trend of the source's distance and angle, is fitted to the counts,
    weighted as Poisson's noise asks and so that single pixels cannot pull at it. Efficiencies are counts by trend. Dead or
    hot is a pixel 5.5 standard deviations off the trend: of the counts' noise (root of the deviance) and of the pixels' own
    differences, by the median of the absolute deviations.

    Parameters
    ----------
    flood
        Counts (M, n_v, n_u), as the images of the runs whose efficiency they are to give: the same pixels, modules and
        detector plane. 16 counts a pixel or more, or dead pixels cannot be told from chance; the efficiencies are as good as
        their counts, 10,000 for 1 %.
    smooth_order
        Largest power in the polynomial, 0 for none but the mean.
    spread
        Relative standard deviation that pixels may have of their own at least: less than 5.5 of it is neither dead nor hot.
    """
    counts, least = real_array(flood, "flood", (None, None, None)), at_least_0(spread, "flood: spread")
    if counts.min(initial=0.0) < 0:
        raise InputError(f"flood: expected counts, 0 or more, got {counts.min():g}")
    one_of(smooth_order, range(9), "flood: smooth_order")
    totals, middles = counts.sum(axis=(1, 2)), np.median(counts, axis=(1, 2))
    is_dead = totals <= _LEAST_SHARE * (np.median(totals[totals > 0]) if totals.any() else 0.0)
    if middles.min(initial=np.inf, where=~is_dead) < _FEWEST:
        warn("flood: a module with few counts in half its pixels: too few to tell dead pixels from chance", 2)
    v, u = (np.linspace(-1, 1, n)[:, None] ** np.arange(smooth_order + 1) for n in counts.shape[1:])
    powers = [(i, j) for i in range(smooth_order + 1) for j in range(smooth_order + 1 - i)]
    basis = np.array([np.outer(v[:, i], u[:, j]).ravel() for i, j in powers])
    found, low, high = (np.zeros(counts.shape, kind) for kind in (float, bool, bool))
    own: list[float] = []
    for m in np.flatnonzero(~is_dead):
        trend = _trend(counts[m], basis, least)
        lives = counts[m] > 0
        for _ in range(3):  # how pixels differ is that of those that live
            off, differing = _deviations(counts[m], trend, least, lives)
            low[m], high[m] = (off < -_SURE) | (counts[m] == 0), off > _SURE
            lives = ~(low[m] | high[m])
        if lives.any():
            ratio = np.where(lives, counts[m] / trend, 0.0)
            found[m] = ratio / ratio[lives].mean()
        own.append(differing)
    dead, hot, modules = (freeze(np.argwhere(which).astype(np.int64)) for which in (low, high, is_dead))
    return FloodEfficiency(freeze(found), dead, hot, modules[:, 0], float(np.mean(own)) if own else 0.0)


def _trend(counts: Array, basis: Floats, least: float) -> Floats:
    """The smooth mean of an image of counts, a sum of the terms (n, pixels) of a `basis`, by iterated weights."""
    values = counts.ravel()
    middle = max(float(np.median(values[values > 0])), 1e-3)
    trend = np.full(values.shape, middle)
    values = np.minimum(values, 3 * middle)  # to begin with
    weights = (values > 0).astype(float)
    for number in range(_ROUNDS):
        scaled = basis * weights
        terms: Any = np.linalg.lstsq(scaled @ basis.T, scaled @ values, rcond=None)[0]
        trend = np.maximum(terms @ basis, 0.05 * middle)
        if number == 0:
            values = counts.ravel()
        off, _ = _deviations(values, trend, least, values > 0)
        weights = (values > 0) / (trend * (1 + (off / _MILD) ** 2))
    return trend.reshape(counts.shape)


def _deviations(counts: Array, trend: Floats, least: float, lives: Array) -> tuple[Floats, float]:
    """How many standard deviations counts are off a trend, and how much pixels that live differ beside noise, relatively."""
    logs = np.log(np.divide(counts, trend), out=np.zeros_like(trend), where=counts > 0)
    off = np.sign(counts - trend) * np.sqrt(np.maximum(2 * (counts * logs - counts + trend), 0))
    ratio, noise = (counts / trend - 1)[lives], (1 / trend)[lives]
    middles = (float(np.median(values)) if values.size else 0.0 for values in (np.abs(ratio), noise))
    own = max((_NORMAL * next(middles)) ** 2 - next(middles), 0.0) ** 0.5
    return off / np.sqrt(1 + trend * max(own, least) ** 2), own
