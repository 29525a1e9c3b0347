"""Channelised Hotelling observer: detection of a signal by the best linear observer of a few channels."""

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
"""Radius of the channels in widths, where the first one has fallen to 0.001 of its central value."""


class ObserverScore(NamedTuple):
    """Performance of the observer in telling images with a signal from those without."""

    auc: Estimate
    snr: float
    """Difference of the mean ratings by their standard deviation, the root mean square of both kinds'."""


def laguerre_gauss(distances: ArrayLike, width: float, channels: int = CHANNELS, dimensions: int = 3) -> Floats:
    """Return Laguerre-Gauss channels at distances from the signal's centre, orthogonal in this number of dimensions.

    They are ``L_p(2 pi r^2 / a^2) exp(-pi r^2 / a^2)`` with the width a and Laguerre's polynomials of order
    ``dimensions / 2 - 1``, a basis of all functions that are the same in all directions.

    Parameters
    ----------
    distances
        (n,), mm.
    width
        a, mm: the first channel's integral along a line through its centre, divided by its value there.
    channels
        Number of channels, p = 0, 1, ...

    Returns
    -------
    array (n, channels)
        Each channel has a Euclidean norm of 1.

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
    profiles = np.exp(-x / 2)[:, None] * np.stack(rows[:channels], axis=1)
    return profiles / np.linalg.norm(profiles, axis=0)


def channel_outputs(volume: Volume, place: ArrayLike, width: float, channels: int = CHANNELS) -> Floats:
    """Return the outputs (channels,) of the channels of `laguerre_gauss` around a place, (3,) mm, of a volume."""
    step = float(volume.grid.spacing.min())
    n = math.ceil(_REACH * width / step)
    axis = step * np.arange(-n, n + 1)
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    values = values_at(volume, real_array(place, "place", (3,)) + offsets).astype(np.float64)
    return values @ laguerre_gauss(np.linalg.norm(offsets, axis=1), width, channels)


def observe(absent: ArrayLike, present: ArrayLike, folds: int = _FOLDS) -> ObserverScore:
    """Measure how well Hotelling's observer tells the channel outputs of images with the signal from those without.

    Its template is the inverse of both kinds' mean covariance times the difference of their means. Each image is rated by a
    template trained on the others: on all but one of `folds` parts, since an observer that rates its training data is too
    optimistic.

    Parameters
    ----------
    absent, present
        Outputs (n, channels), in random order.
    folds
        2 trains on one half and tests on the other, in turn; the number of images leaves one out.

    Raises
    ------
    InputError
        There are too few images of a kind to train on.

    References
    ----------
    H. H. Barrett, K. J. Myers 2004, Foundations of Image Science, section 13.2.12, and those of `laguerre_gauss`.
    """
    kinds = [real_array(outputs, "outputs", (None, None)) for outputs in (absent, present)]
    channels, n_min = kinds[0].shape[1], min(map(len, kinds))
    folds = min(whole_number(folds, "folds"), n_min)
    if folds < 2 or sum(map(len, kinds)) * (1 - 1 / folds) < channels + 3:
        counts = " and ".join(str(len(outputs)) for outputs in kinds)
        raise InputError(f"observer: expected more images of each kind for {channels} channels, got {counts}")
    ratings = [np.empty(len(outputs)) for outputs in kinds]
    for fold in range(folds):
        tested = [np.arange(len(outputs)) % folds == fold for outputs in kinds]
        trained = [outputs[~in_fold] for outputs, in_fold in zip(kinds, tested, strict=True)]
        low, high = (outputs.mean(axis=0) for outputs in trained)
        template = np.linalg.lstsq(sum(np.cov(outputs.T) for outputs in trained) / 2, high - low, rcond=None)[0]
        for outputs, in_fold, kind_ratings in zip(kinds, tested, ratings, strict=True):
            kind_ratings[in_fold] = (outputs[in_fold] - (low + high) / 2) @ template
    below, above = ratings  # without and with the signal
    noise = math.sqrt((below.var(ddof=1) + above.var(ddof=1)) / 2)
    return ObserverScore(area_under_curve(below, above), float(above.mean() - below.mean()) / noise)
