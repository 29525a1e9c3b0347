"""What a pixel counts of the cells around it, plane by plane of depth, and how that moves with the numbers it is made of."""

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array

# Taps that are this small, by what all would be if they were alike, are left out: the spline's inverse makes some negative.
_LEAST = 2e-4

Counts = tuple[int, int]
"""How many along v and u."""


class KernelNumbers(NamedTuple):
    """What the kernels of a zone depend on; lengths in cells, along v and u. Derivatives by them have the same fields."""

    hole: Array
    """(2,): the hole's diameter."""
    slopes: Array
    """(planes,): l / h."""
    edges: Array
    """(2, 3): a voxel's edges as columns, across the line on which it lies by its depth."""
    bend: Array
    """(2,): times squared distances, what the powers of the directions miss."""


def kernels(numbers: KernelNumbers, steps: Counts) -> Array:
    """What a pixel of `steps` cells counts of those around its middle, (planes, taps, taps).

    In Fourier space the exact image, by what the spline has blurred; and `bend` more. It may not be negative anywhere, or
    expected counts would be. All counts of a cell go to the pixels.
    """
    spectra = Spectra(numbers, steps, half_taps(numbers, steps))
    return spectra.of_pixels(spectra.images())[0]


def kernels_gradient(numbers: KernelNumbers, steps: Counts, by_kernels: Array) -> tuple[Array, KernelNumbers]:
    """The kernels, and a function's derivatives by `numbers` from those by the kernels."""
    spectra = Spectra(numbers, steps, half_taps(numbers, steps))
    image = spectra.images()
    found = spectra.of_pixels(image)
    by_image, by_bend, _ = spectra.of_pixels_gradient(by_kernels, image, found)
    return found[0], spectra.gradient(by_image)._replace(bend=by_bend)


def half_taps(numbers: KernelNumbers, steps: Counts, more: ArrayLike = 0.0) -> Counts:
    """Taps on each side of the middle one, along v and u; `more` are those that something else needs."""
    most = 2 * numbers.slopes[-1] - numbers.slopes[-2]
    reach = numbers.hole * (1 + most) / 2 + np.divide(steps, 2) + np.abs(numbers.edges).sum(axis=1) * most / 2 + more
    return tuple(math.ceil(each) + 1 for each in reach)  # type: ignore[return-value]


def _means(image: Array) -> Array:
    """Between planes there are straight lines: on the mean over depths they are right, not at the planes."""
    return image[1:-1] - (image[2:] - 2 * image[1:-1] + image[:-2]) / 12


class Spectra:
    """The spectra of images, factor by factor, for their derivatives, and the kernels that are made of images."""

    def __init__(self, numbers: KernelNumbers, steps: Counts, half: Counts) -> None:
        first, last = numbers.slopes[:2], numbers.slopes[-2:]
        slopes = np.concatenate([[2 * first[0] - first[1]], numbers.slopes, [2 * last[1] - last[0]]])
        self.numbers, self.steps, self.half = numbers, steps, half
        self.slopes = slopes[:, None, None]
        self.n = [_fast_length(2 * h + 8) for h in half]
        self.f = np.fft.fftfreq(self.n[0])[:, None], np.fft.rfftfreq(self.n[1])[None]
        f_v, f_u = self.f
        spline = (np.sinc(f_v) * np.sinc(f_u)) ** 3
        self.pixel = np.sinc(steps[0] * f_v) * np.sinc(steps[1] * f_u) / spline
        self.radius = np.hypot(numbers.hole[0] * f_v, numbers.hole[1] * f_u)
        self.waves = [edge[0] * f_v + edge[1] * f_u for edge in numbers.edges.T]
        self.sincs = [np.sinc(self.slopes * wave) for wave in self.waves]

    @property
    def least(self) -> Array | float:
        """Taps up to this are left out, and it is taken from the others."""
        return _LEAST / math.prod(2 * h + 1 for h in self.half)

    @functools.cached_property
    def common(self) -> Array:
        """The factors of the pixel and the voxel."""
        return np.asarray(self.pixel * self.sincs[0] * self.sincs[1] * self.sincs[2])

    @functools.cached_property
    def _discs(self) -> tuple[Array, Array]:
        return disc_transform((1 + self.slopes) * self.radius)

    def images(self) -> Array:
        """(planes + 2, taps, taps): those of a plane more on either side, too."""
        return self.spatial(self.pixel * self._discs[0] * self.sincs[0] * self.sincs[1] * self.sincs[2])

    def spatial(self, spectra: Array) -> Array:
        """What has these spectra, around the middle tap."""
        image = np.roll(np.fft.irfft2(spectra, self.n), self.half, (1, 2))  # type: ignore[arg-type]
        return image[:, : 2 * self.half[0] + 1, : 2 * self.half[1] + 1]

    def by_spectra(self, by_images: Array) -> Array:
        """The adjoint of `spatial`: its conjugate times changes of spectra, summed, has the images' change as real part."""
        n_v, n_u = self.n
        room = np.zeros((len(by_images), n_v, n_u))
        room[:, : by_images.shape[1], : by_images.shape[2]] = by_images
        spectrum: Array = np.fft.rfft2(np.roll(room, (-self.half[0], -self.half[1]), (1, 2))) / (n_v * n_u)
        spectrum[..., 1:-1] *= 2  # of a real image's spectrum, half is kept
        return spectrum

    def gradient(self, by_images: Array) -> KernelNumbers:
        """Derivatives by the numbers, without `bend`, from those by the images."""
        spectrum = self.by_spectra(by_images).real * self.pixel
        f_v, f_u = self.f
        s, (a, b, c) = self.slopes, self.sincs
        by_disc = spectrum * a * b * c * self._discs[1]
        by_slopes = (by_disc * self.radius).sum(axis=(1, 2))
        by_radius = np.divide((by_disc * (1 + s)).sum(axis=0), self.radius, out=0 * self.radius, where=self.radius > 0)
        by_hole = np.array([hole * (by_radius * f**2).sum() for hole, f in zip(self.numbers.hole, self.f, strict=True)])
        by_edges, of_disc = np.empty((2, 3)), spectrum * self._discs[0]
        for i, (others, wave) in enumerate(zip((b * c, a * c, a * b), self.waves, strict=True)):
            by_wave = of_disc * others * _sinc_rise(s * wave)
            by_slopes += (by_wave * wave).sum(axis=(1, 2))
            by_wave = (by_wave * s).sum(axis=0)
            by_edges[:, i] = (by_wave * f_v).sum(), (by_wave * f_u).sum()
        by_slopes[1:3] += np.array([2, -1]) * by_slopes[0]
        by_slopes[-3:-1] += np.array([-1, 2]) * by_slopes[-1]
        return KernelNumbers(by_hole, by_slopes[1:-1], by_edges, np.zeros(2))

    def of_pixels(self, image: Array) -> tuple[Array, Array, Array]:
        """The kernels of images, with the sums that taps of one place were divided by, and which taps are used."""
        kernel: Array = _means(image) * self._bent()
        kernel -= self.least
        is_used = kernel > 0
        kernel *= is_used
        shares = np.empty_like(kernel)
        for phase in self._phases():
            shares[phase] = kernel[phase].sum(axis=(1, 2), keepdims=True)
        kernel /= shares
        return kernel, shares, is_used

    def of_pixels_gradient(
        self, by_kernels: Array, image: Array, found: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Derivatives by what `of_pixels` has found its kernels from: the image, `bend`, and (planes,) `least`."""
        kernel, shares, is_used = found
        by = np.empty_like(kernel)
        for phase in self._phases():  # of what is divided by its sum
            mean = (by_kernels[phase] * kernel[phase]).sum(axis=(1, 2), keepdims=True)
            by[phase] = by_kernels[phase] - mean
        by *= is_used / shares
        by_least = -by.sum(axis=(1, 2))
        away = self._away()
        plain = by * _means(image)
        by_bend = np.array([(plain * away[0][:, None]).sum(), (plain * away[1]).sum()])
        by *= self._bent()
        by_image = np.zeros_like(image)
        by_image[1:-1] += by * (7 / 6)
        by_image[2:] -= by / 12
        by_image[:-2] -= by / 12
        return by_image, by_bend, by_least

    def _away(self) -> list[Array]:
        return [np.arange(-h, h + 1.0) ** 2 for h in self.half]

    def _bent(self) -> Array:
        """The factors of the taps by `bend`."""
        along_v, along_u = self._away()
        return 1 + self.numbers.bend[0] * along_v[:, None] + self.numbers.bend[1] * along_u

    def _phases(self) -> list[tuple[slice, ...]]:
        """The taps of one cell's place in a pixel, for each place."""
        starts = [[(h - a) % step for a in range(step)] for h, step in zip(self.half, self.steps, strict=True)]
        along = [[slice(start, None, step) for start in own] for own, step in zip(starts, self.steps, strict=True)]
        return [(slice(None), *places) for places in itertools.product(*along)]


def _fast_length(n: int) -> int:
    """The smallest even number from an even n on, for which a Fourier transform is fast: without factors above 5."""
    return next(length for length in itertools.count(n, 2) if 30**16 % length == 0)


def _sinc_rise(x: Array) -> Array:
    """The derivative of ``numpy.sinc``."""
    is_small = np.abs(x) < 1e-3
    safe = np.where(is_small, 1.0, x)
    series = -(np.pi**2) / 3 * x * (1 - (np.pi * x) ** 2 / 10)
    return np.where(is_small, series, (np.cos(np.pi * x) - np.sinc(x)) / safe)


def disc_transform(x: Array) -> tuple[Array, Array]:
    """The Fourier transform of a disc of diameter 1 and integral 1, ``2 J1(pi x) / (pi x)``, and its derivative.

    Cubic pieces between the values and slopes of a table.
    """
    values, slopes, apart = _disc_table(2 ** math.ceil(math.log2(max(16.0, float(x.max())))))
    place = x / apart
    i = np.minimum(place.astype(np.intp), len(values) - 2)
    t = place - i
    low, high, rise, fall = values[i], values[i + 1], slopes[i], slopes[i + 1]
    a, b = 2 * (low - high) + rise + fall, 3 * (high - low) - 2 * rise - fall
    return low + t * (rise + t * (b + t * a)), (rise + t * (2 * b + 3 * t * a)) / apart


@functools.lru_cache(maxsize=8)
def _disc_table(most: int) -> tuple[Array, Array, float]:
    """Values, and slopes from place to place, at places so far apart."""
    ticks = np.linspace(0, most, 64 * most + 1)
    heights = np.cos(np.pi * (np.arange(4 * most) + 0.5) / (8 * most))  # of chords, by Gauss and Chebyshev
    shares = 1 - heights**2
    shares /= shares.sum()
    waves = np.pi * np.outer(ticks, heights)
    return np.cos(waves) @ shares, -np.sin(waves) @ (np.pi * heights * shares) / 64, 1 / 64
