"""Dead time of counters: recorded counts from expected ones, and the inverse.

A counter is busy for the time tau after each photon. If photons do not disturb it meanwhile (non-paralysable), it records
the rate ``m = n / (1 + n tau)`` of a true rate n. If each photon makes it busy anew (paralysable), it records ``m = n exp(-n
tau)``, at most ``1 / (e tau)``, at ``n = 1 / tau``.

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
_STEPS = 12  # steps of Halley's method; 5 are enough except close to the largest rate


def dead_time_counts(
    counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: DeadTimeKind = "non-paralysable"
) -> Floats:
    """Return the counts that counters with dead time record of the expected `counts`.

    Parameters
    ----------
    counts
        Expected counts: images (M, n_v, n_u) of modules, or an array of any other shape with one counter per element.
        Photons in any pixel make the whole module busy, so the recorded share depends on the module's total rate.
    time
        Duration, s, of the measurement: one number, or one for each module (M,) or counter. The rate is taken as constant.
    dead_time
        tau, s: one number, or one for each module (M,) or counter.
    kind
        "non-paralysable" or "paralysable".
    """
    numbers, rates, tau = _check(counts, time, dead_time, kind)
    return numbers * (1 / (1 + rates * tau) if kind == "non-paralysable" else np.exp(-rates * tau))


def dead_time_corrected(
    counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: DeadTimeKind = "non-paralysable"
) -> Floats:
    """Return the counts without dead time from recorded `counts`; the inverse of `dead_time_counts`, with its parameters.

    For a paralysable counter the result is the smaller of the two possible ones. Raises `InputError` for counts that no such
    counter records. The noise of corrected counts is not Poisson noise; therefore reconstructions of runs use the recorded
    shares (`live_shares`) as an efficiency instead.
    """
    return real_array(counts, "counts", None) / live_shares(counts, time, dead_time, kind)


def live_shares(
    counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: DeadTimeKind = "non-paralysable"
) -> Floats:
    """Return the recorded shares of the photons from recorded `counts`: (M, 1, 1) for images, else one for each counter.

    The parameters are those of `dead_time_counts`, but for the counts.
    """
    _, rates, tau = _check(counts, time, dead_time, kind)
    recorded = rates * tau  # m tau
    limit = 1.0 if kind == "non-paralysable" else math.exp(-1)
    worst, tolerated = int(np.argmax(recorded)), limit * (1 - 1e-12 if kind == "non-paralysable" else 1 + 1e-12)
    if recorded.flat[worst] > tolerated:
        worst_tau = float(np.broadcast_to(tau, recorded.shape).flat[worst])
        rate = f"{recorded.flat[worst] / worst_tau:.6g} counts per s at index {worst}"
        largest = f"a {kind} counter that is busy for {worst_tau:g} s records at most {limit / worst_tau:.6g}"
        raise InputError(f"dead time: {rate}, but {largest}")
    if kind == "non-paralysable":
        return 1 - recorded
    # Halley's method solves x exp(-x) = m tau for x = n tau, from a series around the largest rate.
    p = np.sqrt(np.maximum(2 * (1 - math.e * recorded), 0))
    x = 1 - p + p**2 / 3 - 11 / 72 * p**3
    for _ in range(_STEPS):
        target = recorded * np.exp(x)
        error, slope = x - target, 1 - target
        x = x - np.divide(2 * error * slope, 2 * slope**2 + error * target, out=np.zeros_like(x), where=error != 0)
    return np.exp(-np.clip(x, 0, 1))


def _check(counts: ArrayLike, time: ArrayLike, dead_time: ArrayLike, kind: str) -> tuple[Floats, Floats, Floats]:
    """Return counts, total rates, 1/s, and dead times, s; the latter two have the axes (M, 1, 1) for images of modules."""
    one_of(kind, KINDS, "kind")
    numbers = real_array(counts, "counts", None)
    seconds, tau = real_array(time, "time", None), real_array(dead_time, "dead_time", None)
    if not numbers.size or numbers.min() < 0 or tau.min(initial=0.0) < 0 or seconds.min(initial=1.0) <= 0:
        raise InputError("dead time: expected counts and dead_time of 0 or more, and time of more than 0 s")
    totals = numbers
    if numbers.ndim == 3:
        totals = numbers.sum(axis=(1, 2), keepdims=True)
        seconds, tau = (x[:, None, None] if x.ndim == 1 else x for x in (seconds, tau))
    got = f"counts of shape {numbers.shape}, time {np.shape(time)}, dead_time {np.shape(dead_time)}"
    with expecting(f"dead time: expected a number, or one of each module or counter, got {got}"):
        np.broadcast_shapes(totals.shape, np.broadcast_shapes(seconds.shape, tau.shape))
    return numbers, totals / seconds, tau
