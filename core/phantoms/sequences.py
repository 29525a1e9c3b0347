"""Points that fill a box evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_RATIO = 1.2207440846057596  # the real root of x^4 = x + 1


def r3_sequence(n: int, first: int = 0) -> NDArray[np.float64]:
    """`n` points of the unit cube from number `first` on, (3, n).

    M. Roberts' R3, a low-discrepancy (Kronecker) sequence of the generalised golden ratio: any stretch of it is the
    first one, shifted, and two stretches that follow each other fill the cube as evenly as one of twice the length.
    """
    steps = _RATIO ** -np.arange(1.0, 4.0)
    return (0.5 + np.outer(steps, np.arange(first + 1, first + n + 1))) % 1.0
