"""Subsets of views for algorithms that use one subset at a time; each subset sees the object from all sides."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.scanner import rings_along_z
from ..geometry.views import Views
from ..validation import whole_number

_Subset = TypeVar("_Subset")

_RING_GAP = 0.02  # difference in z below which sources form a ring, in units of their mean distance from the origin


def balanced_subsets(views: Views, n: int) -> list[NDArray[np.int64]]:
    """Return the indices of `n` subsets of the views, balanced over rings and angles; their sizes differ by one at most.

    The views are dealt out like cards, ring by ring along z, each ring by the sources' angle around z. Each ring begins
    at another angle than the ring before, so that a subset does not have the same angle of every ring.
    """
    if (n := whole_number(n, "subsets")) > len(views):
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
    """Return an order of `n` subsets in which neighbours see the object from directions that are far apart.

    It goes in steps of about the golden section of `n` that have no divisor in common with it.
    """
    steps = [step for step in range(1, n + 1) if np.gcd(step, n) == 1]
    step = min(steps, key=lambda step: abs(step - n * (3 - 5**0.5) / 2))
    return [k * step % n for k in range(n)]


def in_access_order(subsets: list[_Subset]) -> list[_Subset]:
    """Return a list with an item for each subset, reordered by `access_order`."""
    return [subsets[s] for s in access_order(len(subsets))]
