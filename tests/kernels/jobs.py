"""What test_kernels.py hands to check.c, and how what comes of it is compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
Read = Callable[[Any, tuple[int, ...]], Array]  # the next result, of a kind of number and a shape

KINDS = ("rays", "take", "give", "photons")  # as check.c numbers them
BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, -1e-310, 0.0, -0.0, 1e30, 2.0**31, -(2.0**63))


@dataclass
class Made:
    """Job as check.c reads it, and the function that compares its results."""

    data: bytes
    check: Callable[[Read], None]


def packed(kind: str, level: int, *contents: Any) -> bytes:
    """Pack a job of arrays and ctypes' structures; `level` is taken modulo the processor's number of levels."""
    pieces = (bytes(each) for each in (np.array([KINDS.index(kind), level], np.int64), *contents))
    return b"".join(data + bytes(-len(data) % 8) for data in pieces)


def close(name: str, given: Array, right: Array, allowed: Any) -> None:
    """Assert that numbers are right up to what is allowed; NaN in `right` is not compared."""
    with np.errstate(invalid="ignore"):  # infinity is right where it is right
        error = np.where(np.isnan(right) | (given == right), 0.0, np.abs(given - right))
    bad = ~(error <= allowed)
    assert not bad.any(), f"{name}: {given[bad][0]} instead of {right[bad][0]}, at {np.argwhere(bad)[0]}"
