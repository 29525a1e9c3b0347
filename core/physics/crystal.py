"""Crystal: fractions of the photons that it stops by depth, fractions of pixels within its side, and its blur.

Functions of cosines and positions take arrays, or tensors with torch as their `library`.
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
    """Return the fraction of the photons that are absorbed and assigned to ``depths[layer]``.

    `depths`, mm, are 0 alone, or several from 0 to `thickness`. A fraction exp(-mu z / cosine) of the photons reaches depth
    z. A photon absorbed between two depths is shared between them by linear interpolation, so the total, ``1 - exp(-mu
    thickness / cosine)``, and the mean depth are exact at every angle. `cosine` is that of the angle to the crystal's
    normal; `mu` is in 1/mm and `thickness` in mm.
    """
    exp, expm1 = library.exp, library.expm1
    rate = mu / cosine

    def mean_survival(i: int) -> ArrayOrTensor:
        """Return the mean fraction of photons that reach the depths between ``depths[i]`` and the next one."""
        if i < 0:
            return 1.0
        if i == len(depths) - 1:
            return exp(-rate * thickness)
        start, step = depths[i], depths[i + 1] - depths[i]
        return exp(-rate * start) * -expm1(-rate * step) / (rate * step)

    return mean_survival(layer - 1) - mean_survival(layer)


def recorded_depths(mu: float, thickness: float) -> tuple[float, float]:
    """Return mean and standard deviation, mm, of the depths at which a crystal stops photons along its normal.

    `mu` is its attenuation coefficient, 1/mm, and `thickness` is in mm.
    """
    tau = mu * thickness
    odds = math.exp(-tau) / -math.expm1(-tau)  # photons that pass, relative to those that are stopped
    return (1 - tau * odds) / mu, math.sqrt(1 - tau**2 * odds * (1 + odds)) / mu


def share_inside(middle: ArrayOrTensor, size: ArrayOrTensor, side: ArrayOrTensor) -> ArrayOrTensor:
    """Return the fraction of an interval of length `size` around `middle` that lies within `side` / 2 of 0, all in mm."""
    first, last = (middle - size / 2).clip(min=-side / 2), (middle + size / 2).clip(max=side / 2)
    return (last - first).clip(min=0) / size


def gaussian_blur(n: int, sigma: float, parts: int = 1, blurred: float = 0.0) -> Floats:
    """Return the matrix (n, n parts) that blurs pixel means with a Gaussian of `sigma` pixels.

    It takes the means of the `parts` of each of n pixels, and returns those of the pixels. The means hold the pixels' box
    already, so the Gaussian is sampled, not integrated; the variance that small ones lack is added by one step of diffusion.
    The means may have a part of the blur already, of `blurred` pixels.
    """
    width = math.sqrt(sigma**2 - blurred**2) * parts
    reach = math.ceil(8 * width) + 1  # beyond it float64 has nothing
    squares = np.arange(-reach, reach + 1) ** 2
    kernel = np.exp(-0.5 * squares / max(width, 1e-3) ** 2)
    kernel /= kernel.sum()
    missing = max(width**2 - float(squares @ kernel), 0.0) / 2
    return _blur(n, sigma, parts, np.convolve(kernel, [missing, 1 - 2 * missing, missing]))


def point_blur(n: int, sigma: float) -> Floats:
    """Return the matrix (n, n) from values at the centres of n pixels to their means, blurred by `sigma` pixels."""
    reach = math.ceil(8 * sigma) + 1
    edges = (np.arange(2 * reach + 2) - reach - 0.5) / max(sigma * math.sqrt(2), 1e-9)
    return _blur(n, sigma, 1, np.diff([0.5 * math.erf(x) for x in edges]))


def _blur(n: int, sigma: float, parts: int, kernel: Floats) -> Floats:
    """Return the matrix (n, n parts) of a blur of `sigma` pixels, which far from the ends is `kernel`, by parts of pixels.

    No photons come from beyond an end. A flux that changes linearly up to there is blurred exactly.
    """
    half, width = len(kernel) // 2, sigma * parts
    near = min(n, half // parts + 2)  # pixels that an end has an effect on
    columns = np.arange(max(n * parts, near * parts + half + 1))
    over_pixel = np.pad(np.convolve(kernel, np.ones(parts)), len(columns))
    endless = over_pixel[len(columns) + half + parts - 1 + np.arange(n)[:, None] * parts - columns]
    matrix = endless[:, : n * parts].copy()
    edges = np.arange(near + 1) * parts
    # What the blur changes in the photons between an end and each edge, for fluxes of 1 and of the distance from the end.
    beyond = np.array([0.5 * math.erfc(x / max(width * math.sqrt(2), 1e-9)) for x in edges])
    density = width * np.exp(-0.5 * (edges / max(width, 1e-9)) ** 2) / math.sqrt(2 * math.pi)
    even = np.diff(density - edges * beyond) + parts - endless[:near].sum(axis=1)
    linear = np.diff(width**2 * (1 - beyond) + edges * density + edges**2 * (1 - beyond)) / 2 - endless[:near] @ (
        columns + 0.5
    )
    value, slope = ([1.5, -0.5], [-1, 1]) if n * parts > 1 else ([1], [0])  # at the end, from the two outermost means
    for end in (matrix, matrix[::-1, ::-1]):
        end[:near, : len(value)] += np.outer(even, value) + np.outer(linear, slope)
    return matrix.clip(min=0)
