"""Dead time: what a counter records that is busy for a while after each photon, and how many photons there were.

A counter that photons do not disturb while it is busy (non-paralysable) records ``m = n / (1 + n tau)`` of a rate n. One
that each photon makes busy anew (paralysable) records ``m = n exp(-n tau)``, at most ``1 / (e tau)``, at ``n = 1 / tau``.

Reference: G. F. Knoll, "Radiation Detection and Measurement", 4th edition (2010), section 4.VII.
"""

import math
from typing import Literal

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError, expecting
from ..validation import one_of, real_array

DeadTimeKind = Literal["non-paralysable", "paralysable"]
KINDS = ("non-paralysable", "paralysable")
_STEPS = 12  # of Halley's method: 5 are enough but next to the maximum


def dead_time_counts(
    counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: DeadTimeKind = "non-paralysable"
) -> Floats:
    """The counts that are recorded of those expected.

    Parameters
    ----------
    counts
        Images (M, n_v, n_u) of modules: photons in any pixel make the whole module busy, so its total rate says what share
        of them is recorded. Any other array is of counters of their own.
    time
        In which they are counted, s: one number, or those of the modules (M,) or counters. The rate is taken as even.
    dead_time
        tau, s, as many.
    kind
        "non-paralysable" or "paralysable".
    """
    numbers, rates, busy = _checked(counts, time, dead_time, kind)
    return numbers * (1 / (1 + rates * busy) if kind == "non-paralysable" else np.exp(-rates * busy))


def dead_time_corrected(
    counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: DeadTimeKind = "non-paralysable"
) -> Floats:
    """The counts without dead time of those recorded: the inverse of `dead_time_counts`, whose parameters it takes.

    Of a paralysable counter it is the smaller of the two that are possible. Counts that no such counter records are refused.
    The noise of corrected counts is not Poisson's: reconstructions of runs take the share that `live_shares` gives for an
    efficiency instead.
    """
    return real_array(counts, "counts", None) / live_shares(counts, time, dead_time, kind)


def live_shares(
    counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: DeadTimeKind = "non-paralysable"
) -> Floats:
    """The shares of the photons that are recorded, from recorded counts: (M, 1, 1) of images, else of each counter."""
    _, rates, busy = _checked(counts, time, dead_time, kind)
    recorded = rates * busy
    most = 1.0 if kind == "non-paralysable" else math.exp(-1)
    worst, beyond = int(np.argmax(recorded)), most * (1 - 1e-12 if kind == "non-paralysable" else 1 + 1e-12)
    if recorded.flat[worst] > beyond:
        tau = float(np.broadcast_to(busy, recorded.shape).flat[worst])
        found = f"{recorded.flat[worst] / tau:.6g} counts per s at index {worst}"
        can = f"a {kind} counter that is busy for {tau:g} s records at most {most / tau:.6g}"
        raise InputError(f"dead time: {found}, but {can}")
    if kind == "non-paralysable":
        return 1 - recorded
    p = np.sqrt(np.maximum(2 * (1 - math.e * recorded), 0))
    x = 1 - p + p**2 / 3 - 11 / 72 * p**3  # around the maximum; x exp(-x) = recorded
    for _ in range(_STEPS):
        part = recorded * np.exp(x)
        off, slope = x - part, 1 - part
        x = x - np.divide(2 * off * slope, 2 * slope**2 + off * part, out=np.zeros_like(x), where=off != 0)
    return np.exp(-np.clip(x, 0, 1))


def _checked(counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: str) -> tuple[Floats, Floats, Floats]:
    """Counts, their rates, 1/s, and dead times, s: of images with the axes (M, 1, 1)."""
    one_of(kind, KINDS, "kind")
    numbers = real_array(counts, "counts", None)
    seconds, busy = real_array(time, "time", None), real_array(dead_time, "dead_time", None)
    if not numbers.size or numbers.min() < 0 or busy.min(initial=0.0) < 0 or seconds.min(initial=1.0) <= 0:
        raise InputError("dead time: expected counts and dead_time of 0 or more, and time of more than 0 s")
    totals = numbers
    if numbers.ndim == 3:
        totals = numbers.sum(axis=(1, 2), keepdims=True)
        seconds, busy = (x[:, None, None] if x.ndim == 1 else x for x in (seconds, busy))
    got = f"counts of shape {numbers.shape}, time {np.shape(time)}, dead_time {np.shape(dead_time)}"
    with expecting(f"dead time: expected a number, or one of each module or counter, got {got}"):
        np.broadcast_shapes(totals.shape, np.broadcast_shapes(seconds.shape, busy.shape))
    return numbers, totals / seconds, busy
