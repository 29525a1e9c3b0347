"""Efficiencies of pixels from a flood, the image of an even source: its counts divided by their smooth trend."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array, ArrayLike, Floats, Integers
from ..errors import InputError, warn
from ..validation import at_least_0, freeze, one_of, real_array

_OUTLIER = 5.5
"""Number of standard deviations of a dead or hot pixel; by chance one pixel in 5e7 exceeds it, on either side."""
_MILD_OUTLIER = 2.0
"""Number of standard deviations at which a pixel's weight in the fit of the trend is halved (Cauchy)."""
_ITERATIONS = 30
_MIN_COUNTS = 16  # counts per pixel; with fewer, pixels are empty by chance too often
_DEAD_MODULE_SHARE = 0.01
"""Total counts of a module, relative to the median of the modules, up to which it is dead."""
_NORMAL = 1.4826  # ratio of the standard deviation of a normal distribution to its median absolute deviation


@dataclass(frozen=True, eq=False)
class FloodEfficiency:
    """Efficiencies and defects of the pixels of M modules; its text is a summary in one line."""

    efficiency: Floats
    """Efficiencies (M, n_v, n_u), as `Emission` takes them: mean 1 over the good pixels of each module, 0 for others."""
    dead: Integers
    """Module, row and column (n, 3), from 0, of dead pixels, those with too few counts in modules that are not dead."""
    hot: Integers
    """Module, row and column (n, 3), from 0, of hot pixels, those with too many counts."""
    dead_modules: Integers
    """Indices (n,) of modules, from 0, that have no counts or nearly none."""
    spread: float
    """Relative standard deviation of the good pixels' efficiencies, without the noise of the counts."""

    def __str__(self) -> str:
        modules, rows, columns = self.efficiency.shape
        defects = f"{len(self.dead)} dead and {len(self.hot)} hot pixels, {len(self.dead_modules)} dead modules"
        return f"{modules} modules of {columns} x {rows} pixels: {defects}; others vary by {self.spread:.2%}"


def flood_efficiency(flood: ArrayLike, smooth_order: int = 2, spread: float = 0.05) -> FloodEfficiency:
    """Return the efficiencies of pixels, and the dead and hot ones, from the image of an even source.

    In each module a polynomial of rows and columns, the trend of the source's distance and angle, is fitted to the counts,
    with the weights of Poisson noise and robustly, so that single pixels do not distort it. Efficiencies are counts divided
    by the trend. A pixel is dead or hot if it deviates by more than 5.5 standard deviations from the trend. The variance is
    the sum of the counts' noise (deviance residuals) and of the spread of the efficiencies (median of the absolute
    deviations).

    Parameters
    ----------
    flood
        Counts (M, n_v, n_u) with the modules, pixels and detector plane of the runs that use the efficiencies. With fewer
        than 16 counts per pixel dead pixels cannot be told from chance. The counts also limit the accuracy of the
        efficiencies: 10,000 counts give 1 %.
    smooth_order
        Largest power in the polynomial; 0 for a constant trend.
    spread
        Smallest assumed relative standard deviation of the efficiencies: a deviation of less than 5.5 times this is neither
        dead nor hot.
    """
    counts, min_spread = real_array(flood, "flood", (None, None, None)), at_least_0(spread, "flood: spread")
    if counts.min(initial=0.0) < 0:
        raise InputError(f"flood: expected counts, 0 or more, got {counts.min():g}")
    one_of(smooth_order, range(9), "flood: smooth_order")
    totals, medians = counts.sum(axis=(1, 2)), np.median(counts, axis=(1, 2))
    is_dead = totals <= _DEAD_MODULE_SHARE * (np.median(totals[totals > 0]) if totals.any() else 0.0)
    if medians.min(initial=np.inf, where=~is_dead) < _MIN_COUNTS:
        warn("flood: a module with few counts in half its pixels: too few to tell dead pixels from chance", 2)
    v, u = (np.linspace(-1, 1, n)[:, None] ** np.arange(smooth_order + 1) for n in counts.shape[1:])
    powers = [(i, j) for i in range(smooth_order + 1) for j in range(smooth_order + 1 - i)]
    basis = np.array([np.outer(v[:, i], u[:, j]).ravel() for i, j in powers])
    efficiency, is_low, is_high = (np.zeros(counts.shape, dtype) for dtype in (float, bool, bool))
    spreads: list[float] = []
    for m in np.flatnonzero(~is_dead):
        trend = _trend(counts[m], basis, min_spread)
        is_good = counts[m] > 0
        for _ in range(3):  # because the spread is that of the good pixels, which depend on it
            residuals, module_spread = _deviations(counts[m], trend, min_spread, is_good)
            is_low[m], is_high[m] = (residuals < -_OUTLIER) | (counts[m] == 0), residuals > _OUTLIER
            is_good = ~(is_low[m] | is_high[m])
        if is_good.any():
            ratio = np.where(is_good, counts[m] / trend, 0.0)
            efficiency[m] = ratio / ratio[is_good].mean()
        spreads.append(module_spread)
    dead, hot, modules = (freeze(np.argwhere(mask).astype(np.int64)) for mask in (is_low, is_high, is_dead))
    return FloodEfficiency(freeze(efficiency), dead, hot, modules[:, 0], float(np.mean(spreads)) if spreads else 0.0)


def _trend(counts: Array, basis: Floats, min_spread: float) -> Floats:
    """Return the smooth trend of an image of counts in the `basis` (n, pixels), by iteratively reweighted least squares."""
    values = counts.ravel()
    median = max(float(np.median(values[values > 0])), 1e-3)
    trend = np.full(values.shape, median)
    values = np.minimum(values, 3 * median)  # hot pixels are clipped in the first iteration
    weights = (values > 0).astype(float)
    for iteration in range(_ITERATIONS):
        scaled = basis * weights
        terms: Any = np.linalg.lstsq(scaled @ basis.T, scaled @ values, rcond=None)[0]
        trend = np.maximum(terms @ basis, 0.05 * median)
        if iteration == 0:
            values = counts.ravel()
        residuals, _ = _deviations(values, trend, min_spread, values > 0)
        weights = (values > 0) / (trend * (1 + (residuals / _MILD_OUTLIER) ** 2))
    return trend.reshape(counts.shape)


def _deviations(counts: Array, trend: Floats, min_spread: float, is_good: Array) -> tuple[Floats, float]:
    """Return the deviance residuals of the counts from `trend`, and the relative spread of good pixels beyond Poisson noise.

    The residuals are in standard deviations of the noise and of the spread, which is at least `min_spread`.
    """
    logs = np.log(np.divide(counts, trend), out=np.zeros_like(trend), where=counts > 0)
    deviance = np.sign(counts - trend) * np.sqrt(np.maximum(2 * (counts * logs - counts + trend), 0))
    ratio, noise = (counts / trend - 1)[is_good], (1 / trend)[is_good]
    medians = (float(np.median(values)) if values.size else 0.0 for values in (np.abs(ratio), noise))
    spread = max((_NORMAL * next(medians)) ** 2 - next(medians), 0.0) ** 0.5
    return deviance / np.sqrt(1 + trend * max(spread, min_spread) ** 2), spread
