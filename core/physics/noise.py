"""Poisson noise of counts."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..validation import real_array, seed_number

# numpy draws no Poisson numbers with a larger mean.
_LARGEST_MEAN = 9e18


def sample_counts(mean: ArrayLike, seed: int) -> NDArray[np.int64]:
    """Counts drawn from Poisson distributions with given means.

    `mean` is (M, n_v, n_u) or any array whose first axis is the views. Each view has its own random generator, made from
    the seed, a whole number from 0 to 2^64 - 1, and the view's index, so its counts do not depend on the other views.
    """
    seed = seed_number(seed)
    values = real_array(mean, "expected counts", None)
    if not values.ndim:
        raise InputError("expected counts: expected an array whose first axis is the views, got one number")
    if values.size and not 0 <= values.min() <= values.max() <= _LARGEST_MEAN:
        raise InputError(
            f"expected counts: must lie from 0 to {_LARGEST_MEAN:g}, got {values.min():g} to {values.max():g}"
        )
    counts = np.empty(values.shape, np.int64)
    for view, expected in enumerate(values):
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(view,)))
        counts[view] = generator.poisson(expected)
    return counts
