"""Spots of point sources in the modules' images: their centres, the centres' covariances, and tests of their shape.

If the radius of the hole's shadow, its counts and a uniform background are free in each image, and the crystal's blur in
all images together, an image depends on the geometry only through the shadow's centre. The centres and their covariances
are therefore all that a calibration needs; activity, hole diameter, blur and the crystal's efficiency have no influence on
a module's position.
"""

from dataclasses import dataclass, replace

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
    sigma_sd: Floats
    """Standard deviations (M,) of `sigma`, mm."""
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
    def centers(self) -> Floats:
        """Centres (K, M, 2), mm on the crystal's front."""
        return self.values[..., :2]

    def expected(self, centers: Floats) -> Floats:
        """Return the expected counts in the windows (K, M, n_v, n_u) for spots at `centers` (K, M, 2), mm."""
        spots = zip(centers, self.values[..., 2], self.magnification, self.first, strict=True)
        shape = self.windows.shape[2:]
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
    images: Floats,
    background: Floats,
    model: SpotModel,
    sigma: Floats,
    magnification: Floats,
    start: Spots | None = None,
    progress: Progress | None = None,
) -> Spots:
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
    reach = (radii.max(axis=0) + 3 * sigma + model.parallax)[:, None] / pitch
    n_u, n_v = np.minimum(2 * (np.ceil(reach.max(axis=0)).astype(int) + _MARGIN) + 1, size)
    cut = [
        _cut_windows(x, np.broadcast_to(background, x.shape), model, r, (n_v, n_u))
        for x, r in zip(images, radii, strict=True)
    ]
    seen, values, first, windows, background_windows = (np.array(arrays) for arrays in zip(*cut, strict=True))
    if start is not None:
        values = np.where((start.seen & seen)[..., None], start.values, values)
    spots = Spots(model, magnification, sigma, 0 * sigma, seen, values, np.zeros((*seen.shape, 3, 3)), first, windows,
                  background_windows, 0.0 * seen, 0.0 * seen)  # fmt: skip
    spots = _maximize_likelihood(spots, start is None, progress)
    pixels = (spots.centers - model.lattice.first) / model.lattice.step
    inside = np.minimum(pixels, size - 1 - pixels) + 0.5 >= spots.values[..., 2, None] / pitch
    inside &= np.abs(pixels - first - [n_u // 2, n_v // 2]) < [n_u // 2, n_v // 2]
    return replace(spots, seen=seen & inside.all(axis=2))


def _cut_windows(
    counts: Floats, background: Floats, model: SpotModel, radii: Floats, shape: tuple[int, int]
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
    windows, known = (x[np.arange(len(x))[:, None, None], rows, columns] for x in (counts, background))
    excess = windows - known - uniform[:, None, None]
    totals = excess.sum((1, 2))
    seen = (totals >= _MIN_COUNTS) & (totals > _SIGNIFICANCE * np.sqrt(windows.sum((1, 2))))
    moments = (excess.sum(axis) * np.arange(n) for axis, n in ((1, n_u), (2, n_v)))
    centroids = np.stack([moment.sum(1) / np.where(seen, totals, np.inf) for moment in moments], axis=1)
    centers = lattice.first + lattice.step * (first + centroids)
    return seen, np.column_stack([centers, radii, np.maximum(totals, 1.0), uniform]), first, windows, known


def _maximize_likelihood(spots: Spots, is_first: bool, progress: Progress | None = None) -> Spots:
    """Return the spots with the values and the blur of the largest likelihood, from those that they have.

    A background at its lower limit is returned as 0.
    """
    model, values, seen = spots.model, spots.values.copy(), spots.seen
    pitch = np.abs(model.lattice.step)
    profile = spots.sigma / spots.sigma.max()  # of the modules' blur
    square, square_sd = float(spots.sigma.max() ** 2), 0.0
    expected_radii = model.hole_radius * (1 + spots.magnification)
    most_square = 4 * square  # a wider blur needs larger windows
    n_first = _FIRST_STEPS if is_first else 0
    least = (_MIN_BLUR * float(pitch.min())) ** 2
    covariance = spots.covariance.copy()
    for step in range(_STEPS):
        tell(progress, step, _STEPS)
        sigma = profile * np.sqrt(square)
        terms = []
        floor = _MIN_BACKGROUND * values[..., 3] * pitch.prod(axis=1) / (np.pi * (values[..., 2] ** 2 + 4 * sigma**2))
        values[..., 4] = np.maximum(values[..., 4], floor)
        for k, known in enumerate(spots.background):
            fractions, d_fractions = model.fractions(
                values[k, :, :2], values[k, :, 2], sigma, spots.magnification[k], known.shape[1:], spots.first[k]
            )
            counts, uniform = values[k, :, 3:, None, None].swapaxes(0, 1)
            expected = counts * fractions + uniform + known
            by_square = profile**2 / (2 * sigma)  # of sigma
            d_fractions[2] *= step >= n_first
            d_fractions[3] *= by_square[:, None, None]
            gradient = np.stack(
                [*counts * d_fractions[:3], fractions, np.ones_like(fractions), counts * d_fractions[3]], 1
            )
            gradient = gradient.reshape(*gradient.shape[:2], -1)  # of the expected counts, (M, 6, pixels)
            weighted = gradient / expected.reshape(len(gradient), 1, -1)
            excess = spots.windows[k] - expected
            chi_square = (excess**2 / np.maximum(expected, 1)).sum((1, 2)) / (expected >= 1).sum((1, 2)).clip(1)
            information = weighted @ gradient.swapaxes(1, 2)
            slope = (weighted @ excess.reshape(len(gradient), -1, 1))[..., 0]
            diagonal = information.diagonal(axis1=1, axis2=2)[:, :5]
            information[:, :5, :5] += (1e-9 * diagonal + 1e-30)[:, :, None] * np.eye(5)
            inverse = np.linalg.inv(information[:, :5, :5])
            along = (inverse @ information[:, :5, 5:])[..., 0]  # change of the values by the blur's square
            steps = (inverse @ slope[:, :5, None])[..., 0]
            rest = slope[:, 5] - (along * slope[:, :5]).sum(axis=1)
            known_better = information[:, 5, 5] - (along * information[:, :5, 5]).sum(axis=1)
            covariance[k] = inverse[:, :3, :3]
            terms.append((steps, along, rest, known_better, chi_square, np.sqrt(inverse.diagonal(axis1=1, axis2=2))))
        steps, along, score, gain, chi_square, sd = map(np.array, zip(*terms, strict=True))
        good = seen & (chi_square <= _MAX_CHI_SQUARE * np.median(chi_square[seen])) if seen.any() else seen
        total = max(float(gain[good].sum()), 1e-30)
        change = float(np.clip(square + score[good].sum() / total, max(square / 4, least), most_square)) - square
        steps -= along * change
        square, square_sd = square + change, total**-0.5
        # A step moves the centre by at most half a radius, and changes radius and counts by at most half.
        most = 0.5 * values[..., [2, 2, 2, 3]]
        steps *= np.minimum((most / np.maximum(np.abs(steps[..., :4]), 1e-30)).min(axis=2), 1.0)[..., None]
        values += steps
        values[..., 2] = np.clip(values[..., 2], *(limit * expected_radii for limit in _RADII))
        size = np.abs(steps) / sd
        size[..., 4] *= values[..., 4] > 1.01 * floor  # a background at its limit cannot decrease further
        if step >= n_first and size[seen].max(initial=0.0) < _CONVERGED and abs(change) < 0.1 * square_sd:
            break
    tell(progress, _STEPS, _STEPS)
    values[..., 4] = np.where(values[..., 4] > 1.01 * floor, values[..., 4], 0.0)
    sigma = profile * np.sqrt(square)
    sigma_sd = profile * min(square_sd / (2 * np.sqrt(square)), np.sqrt(square_sd))
    return replace(spots, values=values, covariance=covariance, sigma=sigma, sigma_sd=sigma_sd, score=score, gain=gain)
