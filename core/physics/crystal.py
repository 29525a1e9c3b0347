"""The crystal: the photons it stops and at which depth, its pixels' shares, and its blur.

Functions of cosines and positions take arrays, or tensors and their `library`, torch.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arrays import ArrayOrTensor, Floats


def absorbed_share(
    cosine: ArrayOrTensor,
    mu: ArrayOrTensor,
    thickness: ArrayOrTensor,
    depths: Sequence[ArrayOrTensor],
    layer: int,
    library: Any = np,
) -> ArrayOrTensor:
    """Fraction of the photons that are assigned to ``depths[layer]``: of 0 alone, or of depths from 0 to `thickness`.

    A fraction exp(-mu z / cosine) of the photons reaches depth z. A photon absorbed between two depths is shared
    between them by linear interpolation, so the total, ``1 - exp(-mu thickness / cosine)``, and the mean depth are
    exact at every angle. `cosine` is that of the angle to the crystal's normal; `mu` is in 1/mm and `thickness` in mm.
    """
    exp, expm1 = library.exp, library.expm1
    rate = mu / cosine

    def reached(first: int) -> ArrayOrTensor:
        """Mean fraction of photons that reach the depths from `first` to the next one."""
        if first < 0:
            return 1.0
        if first == len(depths) - 1:
            return exp(-rate * thickness)
        start, step = depths[first], depths[first + 1] - depths[first]
        return exp(-rate * start) * -expm1(-rate * step) / (rate * step)

    return reached(layer - 1) - reached(layer)


def recorded_depths(mu: float, thickness: float) -> tuple[float, float]:
    """Mean, and standard deviation, of the depths, mm, at which a crystal stops photons along its normal."""
    tau = mu * thickness
    left = math.exp(-tau) / -math.expm1(-tau)
    return (1 - tau * left) / mu, math.sqrt(1 - tau**2 * left * (1 + left)) / mu


def share_inside(middle: ArrayOrTensor, size: ArrayOrTensor, side: ArrayOrTensor) -> ArrayOrTensor:
    """Fractions of intervals of length `size` around `middle` that lie within `side` / 2 of 0, all in mm."""
    first, last = (middle - size / 2).clip(min=-side / 2), (middle + size / 2).clip(max=side / 2)
    return (last - first).clip(min=0) / size


def gaussian_blur(n: int, sigma: float) -> Floats:
    """Matrix (n, n) that blurs n pixels with a Gaussian of `sigma` pixels, integrated over each receiving pixel."""
    with np.errstate(divide="ignore"):  # no blur, of some modules: 1 on the diagonal
        edges = (np.arange(n + 1) - 0.5) / (sigma * math.sqrt(2))
    kernel = np.diff([0.5 * math.erf(x) for x in edges])
    distance = np.abs(np.arange(n)[:, None] - np.arange(n))
    return kernel[distance]
