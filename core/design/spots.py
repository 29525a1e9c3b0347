"""Spots: where each module sees a point source, how well its counts tell that, and whether they are those of a disc.

An image depends on the geometry through the middle of the hole's shadow alone, once the shadow's radius, its counts and an
even background are free in each image. So middles and their covariances are all that a calibration needs, and neither the
activity, nor the hole's diameter, nor the crystal's efficiency decide over a module's place.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Bools, Floats
from ..progress import Progress, tell
from .point_images import Lattice, disc_shares
from .solvers import scipy_module

_MARGIN = 3  # pixels around the expected shadow
_FEWEST, _SIGNIFICANT = 20, 6.0  # counts of a spot; standard deviations that they are above the background
_STEPS, _CONVERGED = 25, 0.01  # of Fisher's scoring; standard deviations that its last step moves
_FLOOR = 1e-5  # least background of a pixel, as a share of one that the shadow covers: strays are not impossible


@dataclass(frozen=True)
class Spots:
    """The spots of K acquisitions in M modules, by `find_spots`."""

    seen: Bools  # (K, M): where there is one, whole
    pixels: Floats  # (K, M, 2): column and row of their middles
    covariance: Floats  # (K, M, 2, 2), px^2
    radii: Floats  # (K, M), of the shadows, mm
    counts: Floats  # (K, M), of the spots
    even: Floats  # (K, M): background of a pixel, besides the known one
    first: Array  # (K, M, 2): column and row of the first pixels of windows around the spots
    windows: Floats  # (K, M, n_v, n_u): the counts there
    known: Floats  # (K, M, n_v, n_u): the known background there

    def expected(self, lattice: Lattice, pixels: Floats) -> Floats:
        """The windows' expected counts (K, M, n_v, n_u) if the middles were at these columns and rows (K, M, 2)."""
        n_v, n_u = self.windows.shape[2:]
        pitch, blurs = np.abs(lattice.step), lattice.blurs((n_v, n_u))
        at = zip(pixels - self.first, self.radii, strict=True)
        shares = [disc_shares(middles, radii, pitch, (n_v, n_u), blurs)[0] for middles, radii in at]
        return self.counts[..., None, None] * shares + self.even[..., None, None] + self.known

    def pearson(self, lattice: Lattice) -> tuple[Floats, Floats]:
        """Pearson's sum of squares (K, M) of the windows, and its degrees of freedom (K, M).

        Pixels that expect less than one count are put together.
        """
        expected = self.expected(lattice, self.pixels)
        bright = expected >= 1
        each = (bright * (self.windows - expected) ** 2 / np.maximum(expected, 1)).sum((2, 3))
        dim, of_dim = ((~bright * counts).sum((2, 3)) for counts in (self.windows, expected))
        together = of_dim >= 1
        rest = together * (dim - of_dim) ** 2 / np.maximum(of_dim, 1)
        freedom = np.asarray(bright.sum((2, 3)) + together - 4, np.float64)  # less middle, radius and counts
        return each + rest, freedom


def find_spots(
    images: Floats, known: Floats, lattice: Lattice, radii: Floats, progress: Progress | None = None
) -> Spots:
    """The spots in images (K, M, n_v, n_u) of one point source in each acquisition.

    From the centroid of the brightest window, Fisher's scoring leads to the largest Poisson likelihood of middle, radius,
    counts and background. Shadows whose edge is sharp, with few counts in a pixel, are known less well than the covariance
    has it.

    Parameters
    ----------
    images, known
        Counts, and the known background, which broadcasts to one acquisition.
    lattice
        The modules' pixels.
    radii
        (M,), mm: about what the shadows have.
    progress
        Counts acquisitions.
    """
    found = []
    for k, counts in enumerate(images):
        found.append(_spots(counts, np.broadcast_to(known, counts.shape), lattice, radii))
        tell(progress, k + 1, len(images))
    return Spots(*(np.array(each) for each in zip(*found, strict=True)))


def _spots(counts: Floats, known: Floats, lattice: Lattice, radii: Floats) -> tuple[Array, ...]:
    """The fields of `Spots` of one acquisition."""
    pitch, size = np.abs(lattice.step), np.array(lattice.shape[::-1])
    reach = np.ceil(((radii + 3 * lattice.sigma)[:, None] / pitch).max(axis=0)).astype(int) + _MARGIN
    n_u, n_v = np.minimum(2 * reach + 1, size)
    even = np.maximum(np.median(counts - known, axis=(1, 2)), 0)
    width = np.ceil(1.5 * (radii[:, None] / pitch).max(axis=0)).astype(int)
    sums = scipy_module("ndimage").uniform_filter(counts - known, (0, width[1], width[0]), mode="constant")
    row, column = np.unravel_index(sums.reshape(len(counts), -1).argmax(axis=1), lattice.shape)
    first = np.clip(np.stack([column, row], axis=1) - [n_u // 2, n_v // 2], 0, size - [n_u, n_v])
    windows, background = (_cut(each, first, n_v, n_u) for each in (counts, known))
    excess = windows - background - even[:, None, None]
    totals = excess.sum((1, 2))
    seen = (totals >= _FEWEST) & (totals > _SIGNIFICANT * np.sqrt(windows.sum((1, 2))))
    centroids = [
        (excess.sum(axis) * np.arange(n)).sum(1) / np.where(seen, totals, np.inf) for axis, n in ((1, n_u), (2, n_v))
    ]
    start = np.stack([*centroids, radii, np.maximum(totals, 1.0), even])
    values, covariance = _likeliest(windows, background, start, pitch, lattice.blurs((n_v, n_u)))
    pixels = first + values[:2].T
    inside = np.minimum(pixels, size - 1 - pixels) + 0.5 >= values[2][:, None] / pitch
    seen &= (inside & (np.abs(pixels - first - reach) < reach)).all(axis=1)
    return seen, pixels, covariance, *values[2:], first, windows, background


def _cut(images: Floats, first: Array, n_v: int, n_u: int) -> Floats:
    """Windows (M, n_v, n_u) of images, each from its own column and row."""
    column, row = first[:, 0, None, None] + np.arange(n_u), first[:, 1, None, None] + np.arange(n_v)[:, None]
    return images[np.arange(len(images))[:, None, None], row, column]


def _likeliest(
    windows: Floats, known: Floats, start: Floats, pitch: Floats, blurs: tuple[Floats, Floats] | None
) -> tuple[Floats, Floats]:
    """Column, row, radius, counts and background (5, S) that windows (S, n_v, n_u) most likely have, from `start`.

    Also the covariance (S, 2, 2) of columns and rows. A background within the floor is returned as 0.
    """
    values, (n_v, n_u) = start.copy(), windows.shape[1:]
    of_spot = (-1, 1, 1)
    for _ in range(_STEPS):
        shares, slopes = disc_shares(values[:2].T, values[2], pitch, (n_v, n_u), blurs)
        floor = _FLOOR * values[3] * pitch.prod(axis=1) / (np.pi * values[2] ** 2)
        values[4] = np.maximum(values[4], floor)
        expected = values[3].reshape(of_spot) * shares + values[4].reshape(of_spot) + known
        slopes = np.stack([*values[3].reshape(of_spot) * slopes, shares, np.ones_like(shares)], axis=1)
        slopes = slopes.reshape(*slopes.shape[:2], -1)
        weighted = slopes / expected.reshape(len(slopes), 1, -1)
        information = weighted @ slopes.swapaxes(1, 2)
        information += 1e-9 * np.eye(5) * information.diagonal(axis1=1, axis2=2)[:, None] + 1e-30 * np.eye(5)
        covariance = np.linalg.inv(information)
        step = (covariance @ (weighted @ (windows - expected).reshape(len(slopes), -1, 1)))[..., 0].T
        size = np.abs(step) / np.sqrt(covariance.diagonal(axis1=1, axis2=2).T)
        wide = values[2] / pitch.T
        most = 0.5 * np.stack([*wide, values[2], values[3]]) / np.maximum(np.abs(step[:4]), 1e-30)
        values += np.minimum(most.min(axis=0), 1.0) * step
        size[4] *= values[4] > 1.01 * floor  # it cannot go farther down
        if size.max() < _CONVERGED:
            break
    values[4] = np.where(values[4] > 1.01 * floor, values[4], 0.0)
    return values, covariance[:, :2, :2]
