"""Spots: where on its crystal each module sees a point source, how well the counts tell it, and whether they are a disc's.

An image depends on the geometry through the middle of the hole's shadow alone, once the shadow's radius, its counts and an
even background are free in each image. So the counts are used up here: middles and covariances are all that a calibration
needs, and neither the activity, nor the hole's diameter, nor the crystal's blur decide over a module's place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..progress import Progress, tell
from ..projector.emission import Emission
from .point_images import Discs, Lattice, each_pixel

_MARGIN = 3  # pixels around the expected shadow
_FEWEST = 20  # counts of a spot
_SIGNIFICANT = 6.0  # standard deviations that a spot has more counts than the background
_STEPS = 25
_CONVERGED = 0.01  # of a standard deviation
_FLOOR = 1e-3  # least background of a pixel, as a share of one that the shadow covers: strays are not impossible


@dataclass(frozen=True)
class Spots:
    """The spots of K acquisitions in M modules, by `find_spots`."""

    pixels: Floats  # (K, M, 2): column and row of their middles; NaN where there is none
    covariance: Floats  # (K, M, 2, 2), px^2
    radii: Floats  # (K, M), of the shadows, mm
    counts: Floats  # (K, M), of the spots
    windows: Floats  # (K, M, n, n): counts around the spots
    expected: Floats  # (K, M, n, n), by the discs
    first: Floats  # (K, M, 2): columns and rows of the windows' first pixels

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(K, M): where there is a spot."""
        return np.isfinite(self.pixels[..., 0])

    def pearson(self) -> tuple[Floats, Floats]:
        """Pearson's sum (K, M) of squared differences from `expected` over the expected variance, and its numbers (K, M).

        Of pixels that expect less than a count, the sums are compared.
        """
        bright = self.expected >= 1
        each = np.where(bright, (self.windows - self.expected) ** 2 / np.where(bright, self.expected, 1.0), 0.0)
        dim, dim_expected = ((~bright * counts).sum((2, 3)) for counts in (self.windows, self.expected))
        rest = (dim - dim_expected) ** 2 / np.maximum(dim_expected, 1e-9)
        pooled = dim_expected >= 1
        return each.sum((2, 3)) + pooled * rest, (bright.sum((2, 3)) + pooled).astype(float)


def find_spots(
    images: Floats, model: Emission, lattice: Lattice, radii: Floats, pixels: Floats | None = None, progress: Progress | None = None
) -> Spots:
    """The spots in images (K, M, n_v, n_u) of one point source in each acquisition.

    The window with most counts, its centroid, and from there the largest Poisson likelihood of middle, radius, counts and
    background, by Fisher's scoring.

    Parameters
    ----------
    images, model, lattice
        Counts, and the modules' physics and pixels.
    radii
        (M,), mm: about what the shadows have.
    pixels
        (K, M, 2): the middles, if they are known; then only the rest is fitted.
    progress
        Counts acquisitions.
    """
    found = []
    sigma = np.broadcast_to(model.optics.intrinsic_fwhm, len(radii)) / 2.355
    reach = (radii + 3 * sigma)[:, None] / np.abs(lattice.step)
    half = int(np.ceil(reach.max())) + _MARGIN
    for k, counts in enumerate(images):
        found.append(_spots(counts, model, lattice, radii, half, None if pixels is None else pixels[k]))
        tell(progress, k + 1, len(images))
    return Spots(*(np.array(each) for each in zip(*found, strict=True)))


def _spots(
    counts: Floats, model: Emission, lattice: Lattice, radii: Floats, half: int, pixels: Floats | None
) -> tuple[Floats, ...]:
    """The fields of `Spots` of one acquisition."""
    n_m, size = len(counts), 2 * half + 1
    known = np.broadcast_to(each_pixel(model.background), counts.shape)
    if pixels is None:
        width = np.maximum(1, np.rint(1.5 * radii[:, None] / np.abs(lattice.step)).astype(int)).max(axis=0)
        middle = _brightest(counts - known, width)
    else:
        middle = np.nan_to_num(pixels)
    first = np.rint(middle).astype(int) - half
    windows, background = (_cut(each, first, size) for each in (counts, known))
    inside = _cut(np.ones_like(counts), first, size)
    discs = Discs.of(model, lattice, np.arange(n_m), first, (size, size))
    outside = np.maximum(((counts - known).sum((1, 2)) - (windows - background).sum((1, 2))), 0)
    even = outside / np.maximum(counts[0].size - inside.sum((1, 2)), 1)
    totals = (windows - background).sum((1, 2)) - even * inside.sum((1, 2))
    noise = np.sqrt(windows.sum((1, 2)) + 1)
    seen = (totals >= _FEWEST) & (totals > _SIGNIFICANT * noise) | (pixels is not None)
    start = np.stack([*middle.T, radii, np.maximum(totals, 1.0), even])
    if pixels is None:
        for _ in range(3):
            start[:2] = _centroids(windows - background - even[:, None, None] * inside, first, start[:2].T, half).T
    fitted, covariance, expected = _likeliest(windows, background, discs, start, pixels is None)
    column, row = fitted[:2]
    shadow = fitted[2][:, None] / np.abs(lattice.step)
    edge = np.minimum(fitted[:2].T, np.array(lattice.shape[::-1]) - 1 - fitted[:2].T) + 0.5
    strayed = np.abs(fitted[:2].T - first - half).max(axis=1) > half
    seen &= (edge > shadow).all(axis=1) & ~strayed & np.isfinite(covariance).all((1, 2))
    places = np.where(seen[:, None], np.stack([column, row], axis=1), np.nan)
    return places, covariance, fitted[2], fitted[3], windows, expected, first


def _brightest(images: Floats, width: Floats) -> Floats:
    """Column and row (M, 2) of the middle of the rectangle of `width` (2,) pixels with most counts in each image."""
    n_u, n_v = width
    sums = np.pad(images, ((0, 0), (n_v // 2 + 1, n_v // 2), (n_u // 2 + 1, n_u // 2))).cumsum(axis=1).cumsum(axis=2)
    boxes = sums[:, n_v:, n_u:] - sums[:, :-n_v, n_u:] - sums[:, n_v:, :-n_u] + sums[:, :-n_v, :-n_u]
    best = boxes.reshape(len(images), -1).argmax(axis=1)
    row, column = np.unravel_index(best, boxes.shape[1:])
    return np.stack([column - (n_u % 2 == 0) * 0.5, row - (n_v % 2 == 0) * 0.5], axis=1)


def _cut(images: Floats, first: Floats, size: int) -> Floats:
    """Windows (M, size, size) of images, 0 beyond their edges."""
    n_v, n_u = images.shape[1:]
    column, row = (first[:, axis, None] + np.arange(size) for axis in (0, 1))
    inside = ((row >= 0) & (row < n_v))[:, :, None] & ((column >= 0) & (column < n_u))[:, None, :]
    at = np.arange(len(images))[:, None, None], np.clip(row, 0, n_v - 1)[:, :, None], np.clip(column, 0, n_u - 1)[:, None, :]
    return np.where(inside, images[at], 0.0)


def _centroids(windows: Floats, first: Floats, middle: Floats, half: int) -> Floats:
    """Centroids (M, 2), column and row, of the counts within `half` pixels of where they are thought to be."""
    index = np.arange(windows.shape[1])
    column, row = ((index + first[:, axis, None]) for axis in (0, 1))
    near_u, near_v = (np.abs(x - m[:, None]) <= half for x, m in zip((column, row), middle.T, strict=True))
    counts = windows * near_v[:, :, None] * near_u[:, None, :]
    total = np.maximum(counts.sum((1, 2)), 1.0)
    moved = np.stack([(counts.sum(1) * column).sum(1), (counts.sum(2) * row).sum(1)], axis=1) / total[:, None]
    return np.clip(moved, first + 1, first + len(index) - 2)


def _likeliest(windows: Floats, known: Floats, discs: Discs, start: Floats, is_free: bool) -> tuple[Floats, Floats, Floats]:
    """Middle, radius, counts and background of the discs that windows (S, n, n) most likely are of, from `start` (5, S).

    Returns these (5, S), the covariance (S, 2, 2) of the middles, and the expected counts (S, n, n). Where the middle is
    not free it stays.
    """
    values, free = start.copy(), slice(0 if is_free else 2, 5)
    widest = start[2] * 5
    area = discs.pitch.prod(axis=1) / np.pi
    for _ in range(_STEPS):
        shares, slopes = discs.shares(values[:2].T, values[2])
        floor = np.minimum(_FLOOR * values[3] * area / values[2] ** 2, values[3])
        values[4] = np.maximum(values[4], floor)
        even = discs.weights * 1.0
        expected = values[3][:, None, None] * shares + values[4][:, None, None] * even + known
        expected = np.maximum(expected, 1e-12)
        slopes = np.concatenate([values[3][:, None, None] * slopes, [shares, even]])[free]
        flat = slopes.reshape(len(slopes), len(windows), -1).swapaxes(0, 1)
        weighted = flat / expected.reshape(len(windows), 1, -1)
        information = weighted @ flat.swapaxes(1, 2)
        score = (weighted @ (windows - expected).reshape(len(windows), -1, 1))[..., 0]
        information += np.eye(information.shape[1]) * (1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] + 1e-30)
        covariance = np.linalg.inv(information)
        step = np.einsum("sij,sj->is", covariance, score)
        size = np.abs(step) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).T)
        whole = np.zeros_like(values)
        whole[free] = step
        most = 0.5 * values[2] / discs.pitch.T
        whole[:2] = np.clip(whole[:2], -most, most)
        values[:2] += whole[:2]
        values[2] = np.clip(values[2] + whole[2], np.maximum(0.6 * values[2], widest / 100), np.minimum(1.6 * values[2], widest))
        values[3:] = np.maximum(values[3:] + whole[3:], 0.2 * values[3:])
        held = values[4] <= floor  # the background, whose steps below are none
        if (size[:-1].max() < _CONVERGED) and (held | (size[-1] < _CONVERGED)).all():
            break
    middle = covariance[:, :2, :2] if is_free else np.zeros((len(windows), 2, 2))
    return values, middle, np.maximum(expected - (held * floor)[:, None, None] * even, 0)
