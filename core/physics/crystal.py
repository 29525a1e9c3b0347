"""The crystal: what it stops, at which depth, where its pixels lie, and how it blurs.

Formulas of a pixel's weight are functions of arrays or of tensors alike.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayOrTensor, namespace

Array = NDArray[np.float64]


def layer_depths(n: int, thickness: float) -> Array:
    """Depths (n,), mm behind the crystal's front, for which photons count: 0 alone, or from front to back."""
    return np.linspace(0.0, thickness, n)


def absorbed_share(
    cosine: ArrayOrTensor, mu: float, thickness: float, depths: NDArray[np.float64], layer: int
) -> ArrayOrTensor:
    """Share of the photons that count for ``depths[layer]``.

    Of the photons, exp(-mu z / cosine) reach depth z. One absorbed between two of the depths counts for both, the more
    for the nearer: so both the number, ``1 - exp(-mu thickness / cosine)``, and the mean depth are exact at every angle.
    With one depth it stands for all.

    Parameters
    ----------
    cosine
        Of the angle to the crystal's normal, array or tensor.
    mu, thickness
        Attenuation coefficient, 1/mm, and mm.
    depths
        From `layer_depths`.
    """
    exp, expm1 = namespace(cosine).exp, namespace(cosine).expm1
    rate = mu / cosine

    def reached(first: int) -> ArrayOrTensor:
        """Mean over the depths from `first` to the next one of the photons that reach them."""
        if first < 0:
            return 1.0
        if first == len(depths) - 1:
            return exp(-rate * thickness)
        start, step = float(depths[first]), float(depths[first + 1] - depths[first])
        return exp(-rate * start) * -expm1(-rate * step) / (rate * step)

    return reached(layer - 1) - reached(layer)


def share_inside(middle: ArrayOrTensor, size: float, side: float) -> ArrayOrTensor:
    """Shares of intervals of length `size` around `middle` that lie within `side` / 2 of 0, all mm."""
    first, last = (middle - size / 2).clip(min=-side / 2), (middle + size / 2).clip(max=side / 2)
    return (last - first).clip(min=0) / size


def gaussian_blur(n: int, sigma: float) -> NDArray[np.float64]:
    """Matrix (n, n) that blurs n pixels with a Gaussian of `sigma` pixels, integrated over the receiving pixel."""
    edges = (np.arange(n + 1) - 0.5) / (sigma * math.sqrt(2))
    kernel = np.diff([0.5 * math.erf(x) for x in edges])
    distance = np.abs(np.arange(n)[:, None] - np.arange(n))
    return kernel[distance]
