"""Spots of point sources in the modules' images: their centres, the centres' covariances, and tests of their shape.

If the radius of the hole's shadow, its counts and a uniform background are free in each image, the image depends on the
geometry only through the shadow's centre. The centres and their covariances are therefore all that a calibration needs;
activity, hole diameter and the crystal's efficiency have no influence on a module's position.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Bools, Floats
from ..progress import Progress, tell
from .point_images import PixelLattice, disc_fractions
from .solvers import scipy_module

_MARGIN = 3  # pixels around the expected shadow
_MIN_COUNTS, _SIGNIFICANCE = 20, 6.0  # of a spot; standard deviations of its counts above the background
_STEPS, _CONVERGED = 25, 0.01  # largest number of Fisher's scoring steps; size of the last one in standard deviations
# Smallest background of a pixel, as a fraction of the counts of a pixel in the shadow: stray counts are always possible.
_MIN_BACKGROUND = 1e-5


@dataclass(frozen=True)
class Spots:
    """Spots of K acquisitions in M modules, found by `find_spots`."""

    seen: Bools
    """Mask (K, M) of the modules with a whole spot."""
    pixels: Floats
    """Centres (K, M, 2), column and row."""
    covariance: Floats
    """Covariance of the centres (K, M, 2, 2), px^2."""
    radii: Floats
    """Radii of the shadows (K, M), mm."""
    counts: Floats
    """Expected counts of the spots (K, M), without background."""
    uniform: Floats
    """Uniform background (K, M), counts per pixel, besides the known one."""
    first: Array
    """Column and row (K, M, 2) of the first pixels of windows around the spots."""
    windows: Floats
    """Counts in the windows (K, M, n_v, n_u)."""
    background: Floats
    """Known background in the windows (K, M, n_v, n_u), counts."""

    def expected(self, lattice: PixelLattice, pixels: Floats) -> Floats:
        """Return the expected counts in the windows (K, M, n_v, n_u) for centres at columns and rows `pixels` (K, M, 2)."""
        n_v, n_u = self.windows.shape[2:]
        pitch, blurs = np.abs(lattice.step), lattice.blurs((n_v, n_u))
        discs = zip(pixels - self.first, self.radii, strict=True)
        fractions = [disc_fractions(centers, radii, pitch, (n_v, n_u), blurs)[0] for centers, radii in discs]
        return self.counts[..., None, None] * fractions + self.uniform[..., None, None] + self.background

    def pearson(self, lattice: PixelLattice) -> tuple[Floats, Floats]:
        """Return Pearson's chi-square (K, M) of the windows, and its degrees of freedom (K, M).

        Pixels with less than one expected count are combined into a single one.
        """
        expected = self.expected(lattice, self.pixels)
        bright = expected >= 1
        bright_sum = (bright * (self.windows - expected) ** 2 / np.maximum(expected, 1)).sum((2, 3))
        dim_counts, dim_expected = ((~bright * counts).sum((2, 3)) for counts in (self.windows, expected))
        has_dim = dim_expected >= 1
        dim_term = has_dim * (dim_counts - dim_expected) ** 2 / np.maximum(dim_expected, 1)
        # Four parameters of each window are fitted: centre (2), radius and counts.
        return bright_sum + dim_term, np.asarray(bright.sum((2, 3)) + has_dim - 4, np.float64)


def find_spots(
    images: Floats, background: Floats, lattice: PixelLattice, radii: Floats, progress: Progress | None = None
) -> Spots:
    """Find the spots in images (K, M, n_v, n_u) of one point source per acquisition.

    Fisher's scoring, from the centroid of the brightest window, finds the maximum of the Poisson likelihood by centre,
    radius, counts and background. For shadows with a sharp edge and few counts per pixel, the stated covariance is too
    small.

    Parameters
    ----------
    images
        Measured counts.
    background
        Known background, which broadcasts to one acquisition.
    lattice
        Pixels of the modules.
    radii
        Approximate radii of the shadows (M,), mm.
    progress
        Called with (done, total) acquisitions.
    """
    acquisitions = []
    for k, counts in enumerate(images):
        acquisitions.append(_find_in_acquisition(counts, np.broadcast_to(background, counts.shape), lattice, radii))
        tell(progress, k + 1, len(images))
    return Spots(*(np.array(arrays) for arrays in zip(*acquisitions, strict=True)))


def _find_in_acquisition(counts: Floats, background: Floats, lattice: PixelLattice, radii: Floats) -> tuple[Array, ...]:
    """Return the fields of `Spots` for the images `counts` (M, n_v, n_u) of one acquisition.

    `background` (M, n_v, n_u) are the known counts besides the spots, `radii` (M,) the approximate radii of the shadows, mm.
    """
    pitch, size = np.abs(lattice.step), np.array(lattice.shape[::-1])
    reach = np.ceil(((radii + 3 * lattice.sigma)[:, None] / pitch).max(axis=0)).astype(int) + _MARGIN
    n_u, n_v = np.minimum(2 * reach + 1, size)
    uniform = np.maximum(np.median(counts - background, axis=(1, 2)), 0)
    width = np.ceil(1.5 * (radii[:, None] / pitch).max(axis=0)).astype(int)
    sums = scipy_module("ndimage").uniform_filter(counts - background, (0, width[1], width[0]), mode="constant")
    row, column = np.unravel_index(sums.reshape(len(counts), -1).argmax(axis=1), lattice.shape)
    first = np.clip(np.stack([column, row], axis=1) - [n_u // 2, n_v // 2], 0, size - [n_u, n_v])
    windows, background_windows = (_cut_windows(images, first, n_v, n_u) for images in (counts, background))
    excess = windows - background_windows - uniform[:, None, None]
    totals = excess.sum((1, 2))
    seen = (totals >= _MIN_COUNTS) & (totals > _SIGNIFICANCE * np.sqrt(windows.sum((1, 2))))
    centroids = [
        (excess.sum(axis) * np.arange(n)).sum(1) / np.where(seen, totals, np.inf) for axis, n in ((1, n_u), (2, n_v))
    ]
    start = np.stack([*centroids, radii, np.maximum(totals, 1.0), uniform])
    values, covariance = _maximize_likelihood(windows, background_windows, start, pitch, lattice.blurs((n_v, n_u)))
    pixels = first + values[:2].T
    inside = np.minimum(pixels, size - 1 - pixels) + 0.5 >= values[2][:, None] / pitch
    seen &= (inside & (np.abs(pixels - first - reach) < reach)).all(axis=1)
    return seen, pixels, covariance, *values[2:], first, windows, background_windows


def _cut_windows(images: Floats, first: Array, n_v: int, n_u: int) -> Floats:
    """Return the windows (M, n_v, n_u) of images, each from its own `first` (M, 2) column and row on."""
    column, row = first[:, 0, None, None] + np.arange(n_u), first[:, 1, None, None] + np.arange(n_v)[:, None]
    return images[np.arange(len(images))[:, None, None], row, column]


def _maximize_likelihood(
    windows: Floats, background: Floats, start: Floats, pitch: Floats, blurs: tuple[Floats, Floats] | None
) -> tuple[Floats, Floats]:
    """Return the maximum-likelihood parameters (5, S) of the spots in windows (S, n_v, n_u), and a covariance (S, 2, 2).

    The parameters are column, row, radius (mm), counts and uniform background, and so are those of `start`; the covariance
    is that of column and row. A background at its lower limit is returned as 0.
    """
    values, (n_v, n_u) = start.copy(), windows.shape[1:]
    per_spot = (-1, 1, 1)
    for _ in range(_STEPS):
        fractions, d_fractions = disc_fractions(values[:2].T, values[2], pitch, (n_v, n_u), blurs)
        floor = _MIN_BACKGROUND * values[3] * pitch.prod(axis=1) / (np.pi * values[2] ** 2)
        values[4] = np.maximum(values[4], floor)
        expected = values[3].reshape(per_spot) * fractions + values[4].reshape(per_spot) + background
        gradient = np.stack([*values[3].reshape(per_spot) * d_fractions, fractions, np.ones_like(fractions)], axis=1)
        gradient = gradient.reshape(*gradient.shape[:2], -1)  # of the expected counts, (S, 5, pixels)
        weighted = gradient / expected.reshape(len(gradient), 1, -1)
        information = weighted @ gradient.swapaxes(1, 2)
        information += 1e-9 * np.eye(5) * information.diagonal(axis1=1, axis2=2)[:, None] + 1e-30 * np.eye(5)
        covariance = np.linalg.inv(information)
        step = (covariance @ (weighted @ (windows - expected).reshape(len(gradient), -1, 1)))[..., 0].T
        size = np.abs(step) / np.sqrt(covariance.diagonal(axis1=1, axis2=2).T)
        radius_in_pixels = values[2] / pitch.T
        # A step moves the centre by at most half a radius, and changes radius and counts by at most half.
        scale = 0.5 * np.stack([*radius_in_pixels, values[2], values[3]]) / np.maximum(np.abs(step[:4]), 1e-30)
        values += np.minimum(scale.min(axis=0), 1.0) * step
        size[4] *= values[4] > 1.01 * floor  # a background at its limit cannot decrease further
        if size.max() < _CONVERGED:
            break
    values[4] = np.where(values[4] > 1.01 * floor, values[4], 0.0)
    return values, covariance[:, :2, :2]
