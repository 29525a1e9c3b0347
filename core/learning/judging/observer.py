"""The channelised Hotelling observer: how well the best linear observer of a few channels sees a signal."""

import math
from typing import NamedTuple

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError
from ...validation import positive, real_array, whole_number
from ...volumes.resampling import values_at
from ...volumes.volume import Volume
from .statistics import Estimate, area_under_curve

CHANNELS = 5
_FOLDS = 10
_REACH = 1.5
"""Channels are cut at this many widths, where the first has fallen to 0.001 of its middle."""


class Observed(NamedTuple):
    """How well the observer tells images with a signal from those without."""

    auc: Estimate
    snr: float
    """Difference of the ratings' means by their standard deviation, the root mean square of both kinds'."""


def laguerre_gauss(distances: ArrayLike, width: float, channels: int = CHANNELS, dimensions: int = 3) -> Floats:
    """Laguerre-Gauss channels at distances from the signal's middle, orthogonal in so many dimensions.

    They are ``L_p(2 pi r^2 / a^2) exp(-pi r^2 / a^2)`` with the width a and Laguerre's polynomials of order
    ``dimensions / 2 - 1``, a basis of all functions that are the same in all directions.

    Parameters
    ----------
    distances
        (n,), mm.
    width
        a, mm: the first channel's integral along a line through its middle, by its value there.
    channels
        How many, p = 0, 1, ...

    Returns
    -------
    array (n, channels)
        Each with a Euclidean norm of 1.

    References
    ----------
    H. H. Barrett, K. J. Myers 2004, Foundations of Image Science, section 14.3.2. B. D. Gallas, H. H. Barrett 2003,
    "Validating the use of channels to estimate the ideal linear observer", J. Opt. Soc. Am. A 20(9), 1725-1738.
    """
    r, order = real_array(distances, "distances", (None,)), dimensions / 2 - 1
    x = 2 * math.pi * (r / positive(width, "width", "mm")) ** 2
    rows = [np.ones_like(x), 1 + order - x]
    for p in range(1, whole_number(channels, "channels")):
        rows.append(((2 * p + 1 + order - x) * rows[p] - (p + order) * rows[p - 1]) / (p + 1))
    found = np.exp(-x / 2)[:, None] * np.stack(rows[:channels], axis=1)
    return found / np.linalg.norm(found, axis=0)


def channel_outputs(volume: Volume, place: ArrayLike, width: float, channels: int = CHANNELS) -> Floats:
    """What the channels (`laguerre_gauss`) around a place, (3,) mm, see of a volume: (channels,)."""
    step = float(volume.grid.spacing.min())
    n = math.ceil(_REACH * width / step)
    axis = step * np.arange(-n, n + 1)
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    values = values_at(volume, real_array(place, "place", (3,)) + offsets).astype(np.float64)
    return values @ laguerre_gauss(np.linalg.norm(offsets, axis=1), width, channels)


def observe(absent: ArrayLike, present: ArrayLike, folds: int = _FOLDS) -> Observed:
    """How well Hotelling's observer tells the channels' outputs of images with the signal from those without.

    Its template is the inverse of both kinds' mean covariance times the difference of their means. Each image is rated by
    a template that the others have trained: all but one of `folds` parts. An observer that rates what it was trained on
    flatters.

    Parameters
    ----------
    absent, present
        Outputs (n, channels), in an order that is random.
    folds
        2 trains on one half and tests on the other, in turn; as many as images leaves one out.

    Raises
    ------
    InputError
        There are too few images of a kind to train on.

    References
    ----------
    See `laguerre_gauss`; Barrett and Myers, section 13.2.12.
    """
    kinds = [real_array(outputs, "outputs", (None, None)) for outputs in (absent, present)]
    channels, fewest = kinds[0].shape[1], min(map(len, kinds))
    folds = min(whole_number(folds, "folds"), fewest)
    if folds < 2 or sum(map(len, kinds)) * (1 - 1 / folds) < channels + 3:
        counts = " and ".join(str(len(outputs)) for outputs in kinds)
        raise InputError(f"observer: expected more images of each kind for {channels} channels, got {counts}")
    ratings = [np.empty(len(outputs)) for outputs in kinds]
    for fold in range(folds):
        tested = [np.arange(len(outputs)) % folds == fold for outputs in kinds]
        trained = [outputs[~own] for outputs, own in zip(kinds, tested, strict=True)]
        low, high = (outputs.mean(axis=0) for outputs in trained)
        template = np.linalg.lstsq(sum(np.cov(outputs.T) for outputs in trained) / 2, high - low, rcond=None)[0]
        for outputs, own, rated in zip(kinds, tested, ratings, strict=True):
            rated[own] = (outputs[own] - (low + high) / 2) @ template
    below, above = ratings
    noise = math.sqrt((below.var(ddof=1) + above.var(ddof=1)) / 2)
    return Observed(area_under_curve(below, above), float(above.mean() - below.mean()) / noise)
