"""Spots of point sources in the modules' images: their centres, the centres' covariances, and tests of their shape.

If the radius of the hole's shadow, its counts and a uniform background are free in each image, and the crystal's blur in
all images together, an image depends on the geometry only through the shadow's centre. The centres and their covariances
are therefore all that a calibration needs; activity, hole diameter, blur and the crystal's efficiency have no influence on
a module's position.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..arrays import Array, Bools, Floats
from ..progress import Progress, tell
from .point_images import SpotModel
from .solvers import scipy_module

_MARGIN = 3  # pixels around the expected shadow
_MIN_COUNTS, _SIGNIFICANCE = 20, 6.0  # of a spot; standard deviations of its counts above the background
_STEPS, _CONVERGED = 40, 0.01  # largest number of Fisher's scoring steps; size of the last one in standard deviations
_FIRST_STEPS = 4  # with the told radii: with a blur far from the right one, too, their best values would be far off
# Smallest background of a pixel, as a fraction of the counts of a pixel in the shadow: stray counts are always possible.
_MIN_BACKGROUND = 1e-5
_RADII = 0.5, 2.0  # limits of a shadow's radius, by that of the hole
_MIN_BLUR = 0.03  # pixels; a smaller blur changes no image
_MAX_CHI_SQUARE = 2.0  # of the spots that the blur is fitted to, by that of half of the spots


@dataclass(frozen=True)
class Spots:
    """Spots of K acquisitions in M modules, found by `find_spots`."""

    model: SpotModel
    """Pixels, hole, crystal and source."""
    magnification: Floats
    """Magnifications (K, M)."""
    sigma: Floats
    """Standard deviations (M,) of the crystals' blur, mm."""
    seen: Bools
    """Mask (K, M) of the modules with a whole spot."""
    values: Floats
    """Centre along u and v, mm on the crystal's front, radius of the shadow, mm, counts, and uniform background, counts per
    pixel, of the spots, (K, M, 5)."""
    covariance: Floats
    """Covariance of the centres and the radius (K, M, 3, 3), mm^2."""
    first: Array
    """Column and row (K, M, 2) of the first pixels of windows around the spots."""
    windows: Floats
    """Counts in the windows (K, M, n_v, n_u)."""
    background: Floats
    """Known background in the windows (K, M, n_v, n_u), counts."""
    score: Floats
    """Derivatives (K, M) of the likelihood's logarithm by the square of the largest `sigma`, 1/mm^2."""
    gain: Floats
    """Information (K, M) of each spot on this square, 1/mm^4."""

    @property
    def sigma_sd(self) -> Floats:
        """Standard deviations (M,) of `sigma`, mm."""
        square_sd = max(float(self.gain[self.seen].sum()), 1e-30) ** -0.5
        widest = float(self.sigma.max())
        return self.sigma / widest * min(square_sd / (2 * widest), square_sd**0.5)

    @property
    def centers(self) -> Floats:
        """Centres (K, M, 2), mm on the crystal's front."""
        return self.values[..., :2]

    def expected(self, centers: Floats) -> Floats:
        """Return the expected counts in the windows (K, M, n_v, n_u) for spots at `centers` (K, M, 2), mm."""
        spots = zip(centers, self.values[..., 2], self.magnification, self.first, strict=True)
        shape = self.windows.shape[2], self.windows.shape[3]
        fractions = [self.model.fractions(x, r, self.sigma, m, shape, first)[0] for x, r, m, first in spots]
        counts, uniform = (self.values[..., i, None, None] for i in (3, 4))
        return counts * fractions + uniform + self.background

    def pearson(self) -> tuple[Floats, Floats]:
        """Return Pearson's chi-square (K, M) of the windows, and its degrees of freedom (K, M).

        Pixels with less than one expected count are combined into a single one.
        """
        expected = self.expected(self.centers)
        bright = expected >= 1
        bright_sum = (bright * (self.windows - expected) ** 2 / np.maximum(expected, 1)).sum((2, 3))
        dim_counts, dim_expected = ((~bright * counts).sum((2, 3)) for counts in (self.windows, expected))
        has_dim = dim_expected >= 1
        dim_term = has_dim * (dim_counts - dim_expected) ** 2 / np.maximum(dim_expected, 1)
        # Four parameters of each window are fitted: centre (2), radius and counts.
        return bright_sum + dim_term, np.asarray(bright.sum((2, 3)) + has_dim - 4, np.float64)


def find_spots(
    images: Floats, background: Floats, model: SpotModel, sigma: Floats, magnification: Floats,
    start: Spots | None = None, progress: Progress | None = None,
) -> Spots:  # fmt: skip
    """Find the spots in images (K, M, n_v, n_u) of one point source per acquisition, and the crystals' blur.

    Fisher's scoring, from the centroid of the brightest window, finds the maximum of the Poisson likelihood by centre,
    radius, counts and background of each spot, and by a factor of the blur of all. For shadows with a sharp edge and few
    counts per pixel, the stated covariance is too small.

    Parameters
    ----------
    images
        Measured counts.
    background
        Known background, which broadcasts to one acquisition.
    model
        Pixels, hole, crystal and source.
    sigma
        Standard deviations (M,) of the blur to start from, mm; their ratios are kept.
    magnification
        Magnifications (K, M).
    start
        Spots of another blur or magnification to start from. None: the centroids of the brightest windows.
    progress
        Called with (done, total) steps.
    """
    radii = model.hole_radius * (1 + magnification)
    pitch, size = np.abs(model.lattice.step), np.array(model.lattice.shape[::-1])
    parallax = model.thickness / 4 * np.abs(model.lattice.first).max(axis=1) / model.length
    reach = (radii.max(axis=0) + 3 * sigma + parallax)[:, None] / pitch
    n_u, n_v = np.minimum(2 * (np.ceil(reach.max(axis=0)).astype(int) + _MARGIN) + 1, size)
    background = np.broadcast_to(background, images.shape)
    cut = map(partial(_cut_windows, model, (n_v, n_u)), images, background, radii)
    has_spot, values, first, windows, known_background = map(np.array, zip(*cut, strict=True))
    if start is not None:
        values = np.where((start.seen & has_spot)[..., None], start.values, values)
    nothing = np.zeros((*has_spot.shape, 3, 3)), first, windows, known_background, 0.0 * has_spot, 0.0 * has_spot
    spots = Spots(model, magnification, sigma, has_spot, values, *nothing)
    spots = _maximize_likelihood(spots, _FIRST_STEPS if start is None else 0, progress)
    pixels = (spots.centers - model.lattice.first) / model.lattice.step
    inside = np.minimum(pixels, size - 1 - pixels) + 0.5 >= spots.values[..., 2, None] / pitch
    inside &= np.abs(pixels - first - [n_u // 2, n_v // 2]) < [n_u // 2, n_v // 2]
    return replace(spots, seen=has_spot & inside.all(axis=2))


def _cut_windows(
    model: SpotModel, shape: tuple[int, int], counts: Floats, background: Floats, radii: Floats
) -> tuple[Bools, Floats, Array, Floats, Floats]:
    """Return the first fields of `Spots` for the images `counts` (M, n_v, n_u) of one acquisition, in windows of `shape`.

    They are the mask of spots, starts of their values, first pixels, windows and their background. `background` (M, n_v,
    n_u) are the known counts besides the spots, `radii` (M,) the approximate radii of the shadows, mm.
    """
    lattice, (n_v, n_u) = model.lattice, shape
    uniform = np.maximum(np.median(counts - background, axis=(1, 2)), 0)
    width = np.ceil(1.5 * (radii[:, None] / np.abs(lattice.step)).max(axis=0)).astype(int)
    sums = scipy_module("ndimage").uniform_filter(counts - background, (0, width[1], width[0]), mode="constant")
    row, column = np.unravel_index(sums.reshape(len(counts), -1).argmax(axis=1), lattice.shape)
    brightest, size = np.stack([column, row], axis=1), np.array(lattice.shape[::-1])
    first = np.clip(brightest - [n_u // 2, n_v // 2], 0, size - [n_u, n_v])
    columns, rows = first[:, 0, None, None] + np.arange(n_u), first[:, 1, None, None] + np.arange(n_v)[:, None]
    windows, known_background = (x[np.arange(len(x))[:, None, None], rows, columns] for x in (counts, background))
    excess = windows - known_background - uniform[:, None, None]
    totals = excess.sum((1, 2))
    has_spot = (totals >= _MIN_COUNTS) & (totals > _SIGNIFICANCE * np.sqrt(windows.sum((1, 2))))
    moments = (excess.sum(axis) * np.arange(n) for axis, n in ((1, n_u), (2, n_v)))
    centroids = np.stack([moment.sum(1) / np.where(has_spot, totals, np.inf) for moment in moments], axis=1)
    centers = lattice.first + lattice.step * (first + centroids)
    values = np.column_stack([centers, radii, np.maximum(totals, 1.0), uniform])
    return has_spot, values, first, windows, known_background


def _maximize_likelihood(spots: Spots, n_first: int, progress: Progress | None) -> Spots:
    """Return the spots with the values and the blur of the largest likelihood, from those that they have.

    During `n_first` steps the radii stay. A background at its lower limit is returned as 0.
    """
    values, seen, pitch = spots.values.copy(), spots.seen, np.abs(spots.model.lattice.step)
    profile, square = spots.sigma / spots.sigma.max(), float(spots.sigma.max()) ** 2
    limits = (_MIN_BLUR * float(pitch.min())) ** 2, 4 * square  # a wider blur needs larger windows
    radii = spots.model.hole_radius * (1 + spots.magnification)
    for step in range(_STEPS):
        tell(progress, step, _STEPS)
        spots = replace(spots, values=values, sigma=profile * square**0.5)
        floor = _MIN_BACKGROUND * values[..., 3] * pitch.prod(axis=1) / (np.pi * (radii**2 + 4 * spots.sigma**2))
        values[..., 4] = np.maximum(values[..., 4], floor)
        terms = (_normal_equations(spots, k, step < n_first) for k in range(len(values)))
        slope, information, chi_square = map(np.array, zip(*terms, strict=True))
        covariance = np.linalg.inv(information[..., :5, :5])
        along = (covariance @ information[..., :5, 5:])[..., 0]  # changes of the values by the blur's square
        score = slope[..., 5] - (along * slope[..., :5]).sum(axis=2)
        gain = information[..., 5, 5] - (along * information[..., :5, 5]).sum(axis=2)
        good = seen & (chi_square <= _MAX_CHI_SQUARE * np.median(chi_square[seen])) if seen.any() else seen
        total = max(float(gain[good].sum()), 1e-30)
        best, previous = square + float(score[good].sum()) / total, square
        square = min(max(best, square / 4, limits[0]), limits[1])
        steps = (covariance @ slope[..., :5, None])[..., 0] - along * (square - previous)
        # A step moves the centre by at most half a radius, and changes radius and counts by at most half.
        allowed_shares = 0.5 * values[..., [2, 2, 2, 3]] / np.maximum(np.abs(steps[..., :4]), 1e-30)
        values = values + steps * np.minimum(allowed_shares.min(axis=2), 1.0)[..., None]
        values[..., 2] = np.clip(values[..., 2], *(limit * radii for limit in _RADII))
        size = np.abs(steps) / np.sqrt(covariance.diagonal(axis1=2, axis2=3))
        size[..., 4] *= values[..., 4] > 1.01 * floor  # a background at its limit cannot decrease further
        if step >= n_first and size[seen].max(initial=0.0) < _CONVERGED and abs(square - previous) * total**0.5 < 0.1:
            break
    values[..., 4] = np.where(values[..., 4] > 1.01 * floor, values[..., 4], 0.0)
    return replace(
        spots, values=values, sigma=profile * square**0.5, covariance=covariance[..., :3, :3], score=score, gain=gain
    )


def _normal_equations(spots: Spots, k: int, holds_radius: bool) -> tuple[Floats, Floats, Floats]:
    """Return the likelihood's slope (M, 6) by acquisition k's values and the blur's square, and the information (M, 6, 6).

    The third array is chi-square per pixel (M,). With `holds_radius` the radii have no influence.
    """
    values, windows, known_background = spots.values[k], spots.windows[k], spots.background[k]
    shape, magnification = (known_background.shape[1], known_background.shape[2]), spots.magnification[k]
    arguments = values[:, :2], values[:, 2], spots.sigma, magnification, shape, spots.first[k]
    fractions, gradient = spots.model.fractions(*arguments)
    counts, uniform = values.T[3:, :, None, None]
    expected = counts * fractions + uniform + known_background
    gradient[2] *= not holds_radius
    gradient[3] *= (spots.sigma / (2 * spots.sigma.max() ** 2))[:, None, None]
    gradient = np.stack([*counts * gradient[:3], fractions, np.ones_like(fractions), counts * gradient[3]], axis=1)
    gradient = gradient.reshape(len(values), 6, -1)  # of the expected counts
    weighted = gradient / expected.reshape(len(values), 1, -1)
    information = weighted @ gradient.swapaxes(1, 2)
    information += (1e-9 * information.diagonal(axis1=1, axis2=2) + 1e-30)[:, :, None] * np.eye(6)
    slope = (weighted @ (windows - expected).reshape(len(values), -1, 1))[..., 0]
    bright = np.maximum(expected, 1)
    return slope, information, ((windows - expected) ** 2 / bright).sum((1, 2)) / (expected >= 1).sum((1, 2)).clip(1)
