"""Noise of counts: random numbers around their means, and the table of the models of noise."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ..arrays import Array, ArrayLike, Integers
from ..errors import InputError
from ..validation import one_of, real_array, seed_number

# Largest mean of which NumPy draws Poisson numbers.
_LARGEST_MEAN = 9e18


def sample_counts(mean: ArrayLike, seed: int, noise: str = "poisson") -> Integers:
    """Draw counts from Poisson distributions with these means, or by another model of `NOISE_MODELS`.

    `mean` is (M, n_v, n_u) or any array whose first axis is the views. Each view has its own random generator, made from
    the seed, a whole number from 0 to 2^64 - 1, and the view's index, so its counts do not depend on the other views.
    """
    one_of(noise, NOISE_MODELS, "noise")
    values = real_array(mean, "expected counts", None)
    if not values.ndim:
        raise InputError("expected counts: expected an array whose first axis is the views, got one number")
    counts = np.zeros(values.shape, np.int64)
    NOISE_MODELS[noise].draw(values, seed, counts)
    return counts


def draw_poisson(mean: Array, seed: int, out: Array) -> None:
    """Draw Poisson counts as `sample_counts` into the array `out`, which has the shape of `mean` or is `mean` itself."""
    seed = seed_number(seed)
    if mean.size and not 0 <= mean.min() <= mean.max() <= _LARGEST_MEAN:
        raise InputError(f"expected counts: must lie from 0 to {_LARGEST_MEAN:g}, got {mean.min():g} to {mean.max():g}")
    for view, (expected, counts) in enumerate(zip(mean, out, strict=True)):
        generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(view,)))
        nonzero = expected != 0  # a mean of 0 gives 0, and takes no random number
        counts[nonzero] = generator.poisson(expected[nonzero])


class NoiseModel(NamedTuple):
    """Model of noise: how counts vary around their means."""

    label: str
    """Name in menus."""
    text: str
    """Line of help."""
    draw: Callable[[Array, int, Array], None]
    """Function of the means, the seed and the array for the counts, such as `draw_poisson`."""


NOISE_MODELS: Mapping[str, NoiseModel] = {
    "poisson": NoiseModel("Poisson", "Independent photons", draw_poisson),
}
"""Models of noise by their names in recipes; a second row makes the choice a setting, ``noise.model``."""
