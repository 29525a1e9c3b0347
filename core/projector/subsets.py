"""Subsets of views that each look at the object from all sides, for algorithms that use one subset at a time."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.scanner import rings_along_z
from ..geometry.views import Views
from ..validation import whole_number

_Subset = TypeVar("_Subset")

_RING_GAP = 0.02  # of the sources' mean distance from the origin: those that differ less in z form a ring


def balanced_subsets(views: Views, n: int) -> list[NDArray[np.int64]]:
    """Indices of `n` subsets of the views, balanced over rings and angles; their sizes differ by one at most.

    The views are dealt out like cards, ring by ring along z, each ring by the sources' angle around z; each ring begins
    farther on than the one before, so that a subset does not have the same angle of every ring.
    """
    n = whole_number(n, "subsets")
    if n > len(views):
        raise InputError(f"subsets: expected at most the {len(views)} views, got {n}")
    x, y, z = views.sources.T
    ring = rings_along_z(z, _RING_GAP * float(np.linalg.norm(views.sources, axis=1).mean()))
    dealt = []
    for r in range(n_rings := int(ring.max()) + 1):
        members = np.flatnonzero(ring == r)
        members = members[np.argsort(np.arctan2(y[members], x[members]), kind="stable")]
        dealt.append(np.roll(members, -(r * len(members)) // n_rings))
    order = np.concatenate(dealt)
    return [np.sort(order[k::n]) for k in range(n)]


def access_order(n: int) -> list[int]:
    """An order of `n` subsets in which neighbours look from directions that are far apart.

    Steps of about the golden section of `n` that have no divisor in common with it.
    """
    steps = [step for step in range(1, n + 1) if np.gcd(step, n) == 1]
    step = min(steps, key=lambda step: abs(step - n * (3 - 5**0.5) / 2))
    return [k * step % n for k in range(n)]


def in_access_order(subsets: list[_Subset]) -> list[_Subset]:
    """What belongs to each subset, in the order in which they are used."""
    return [subsets[s] for s in access_order(len(subsets))]
