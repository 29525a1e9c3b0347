"""Convolution kernels from fine cells to pixels, one for each plane of depth, and their derivatives.

In Fourier space the image of a voxel's piece in a plane is a product of the hole's disc, the piece's shadow and the pixel's
box. Divided by the spectrum of the quadratic B-spline that shares points out among cells, it is the kernel's spectrum.
"""

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array

# Taps below this fraction of the tap of a uniform kernel are left out: division by the spline makes some negative.
_SMALLEST_TAP = 2e-4
# Steps along a cell in which images are computed where pixels have one cell each, so that sharp edges cause no ripples.
_STEPS_OF_ONE_CELL = 2

Pair = tuple[int, int]
"""Two whole numbers, along v and u."""


class KernelShape(NamedTuple):
    """Numbers that the kernels of a zone depend on; lengths in cells, along v and u. A gradient has the same fields."""

    hole_diameter: Array
    """(2,), diameter of the hole."""
    image_scales: Array
    """(planes,), scale l / h of the image of a plane at depth h."""
    voxel_edges: Array
    """(2, 3), edges of a voxel's piece as columns, across the line that stands for its depth."""
    curvature: Array
    """(2,), coefficient c of the second-order term: a tap at the distance x from the centre is multiplied by 1 + c x^2."""


class KernelTaps(NamedTuple):
    """Kernels, with the intermediate arrays that their derivatives need."""

    kernels: Array
    """(planes, taps, taps), the kernels."""
    sums: Array
    """(planes, taps, taps), the sum that each tap was divided by."""
    is_used: Array
    """(planes, taps, taps), whether a tap is large enough."""


def pixel_kernels(shape: KernelShape, cells_per_pixel: Pair) -> Array:
    """Return the convolution kernels (planes, taps, taps) from fine cells to pixels.

    They are the inverse Fourier transform of (disc x voxel shadow x pixel box) / B-spline, times the second-order term.
    Small and negative taps are left out; the weights of each cell in all pixels sum to 1.
    """
    spectra = KernelSpectra(shape, cells_per_pixel, half_taps(shape, cells_per_pixel))
    return spectra.kernel_taps(spectra.images()).kernels


def pixel_kernels_gradient(shape: KernelShape, cells_per_pixel: Pair, d_kernels: Array) -> tuple[Array, KernelShape]:
    """Return the kernels, and the gradient by `shape` of a loss with the gradient `d_kernels` by the kernels."""
    spectra = KernelSpectra(shape, cells_per_pixel, half_taps(shape, cells_per_pixel))
    images = spectra.images()
    taps = spectra.kernel_taps(images)
    d_images, d_curvature, _ = spectra.kernel_taps_gradient(d_kernels, images, taps)
    return taps.kernels, spectra.gradient(d_images)._replace(curvature=d_curvature)


def half_taps(shape: KernelShape, cells_per_pixel: Pair, extra_reach: ArrayLike = 0.0) -> Pair:
    """Return the number of taps on each side of the central one, along v and u; `extra_reach` is in cells."""
    largest_scale = 2 * shape.image_scales[-1] - shape.image_scales[-2]
    shadow, edges = shape.hole_diameter * (1 + largest_scale), np.abs(shape.voxel_edges).sum(axis=1)
    reach = shadow / 2 + np.divide(cells_per_pixel, 2) + edges * largest_scale / 2 + extra_reach
    return tuple(math.ceil(along_axis) + 1 for along_axis in reach)  # type: ignore[return-value]


def _plane_means(images: Array) -> Array:
    """Return the images of the inner planes, corrected for linear interpolation between planes.

    Interpolated images are then right on average over depth, not at the planes: a twelfth of the second difference is taken
    off.
    """
    return images[1:-1] - (images[2:] - 2 * images[1:-1] + images[:-2]) / 12


class KernelSpectra:
    """Spectra of the images of all planes and of one plane more on either side, factor by factor, and their kernels."""

    def __init__(self, shape: KernelShape, cells_per_pixel: Pair, half: Pair) -> None:
        first, last = shape.image_scales[:2], shape.image_scales[-2:]
        scales = np.concatenate([[2 * first[0] - first[1]], shape.image_scales, [2 * last[1] - last[0]]])
        self.shape, self.cells_per_pixel, self.half = shape, cells_per_pixel, half
        self.image_scales = scales[:, None, None]
        self.steps = [_STEPS_OF_ONE_CELL if cells == 1 else 1 for cells in cells_per_pixel]
        self.fft_shape = [step * _fast_length(2 * h + 8) for h, step in zip(half, self.steps, strict=True)]
        (n_v, n_u), (step_v, step_u) = self.fft_shape, self.steps
        self.frequencies = np.fft.fftfreq(n_v, 1 / step_v)[:, None], np.fft.rfftfreq(n_u, 1 / step_u)[None]
        f_v, f_u = self.frequencies
        splines = spline_transform(f_v, cells_per_pixel[0]) * spline_transform(f_u, cells_per_pixel[1])
        self.pixel_by_spline = np.sinc(cells_per_pixel[0] * f_v) * np.sinc(cells_per_pixel[1] * f_u) / splines
        self.radius = np.hypot(shape.hole_diameter[0] * f_v, shape.hole_diameter[1] * f_u)
        self.waves = [edge[0] * f_v + edge[1] * f_u for edge in shape.voxel_edges.T]
        self.sincs = [np.sinc(self.image_scales * wave) for wave in self.waves]

    @property
    def smallest_tap(self) -> Array | float:
        """Value up to which taps are left out, and which is subtracted from the others."""
        return _SMALLEST_TAP / math.prod(2 * h + 1 for h in self.half)

    @functools.cached_property
    def pixel_and_voxel(self) -> Array:
        """Factors of the pixel, the spline and the voxel: the spectra without what passes the hole."""
        return np.asarray(self.pixel_by_spline * self.sincs[0] * self.sincs[1] * self.sincs[2])

    @functools.cached_property
    def _discs(self) -> tuple[Array, Array]:
        """The factor of the hole's disc, and its derivative by the argument."""
        return disc_transform((1 + self.image_scales) * self.radius)

    def images(self) -> Array:
        """Return the images (planes + 2, taps, taps) of the planes and of one more on either side."""
        return self.to_taps(self.pixel_by_spline * self._discs[0] * self.sincs[0] * self.sincs[1] * self.sincs[2])

    def to_taps(self, spectra: Array) -> Array:
        """Return the inverse Fourier transform of `spectra`, around the central tap."""
        images = np.fft.irfft2(spectra, self.fft_shape)[:, :: self.steps[0], :: self.steps[1]]  # type: ignore[arg-type]
        images = np.roll(images * math.prod(self.steps), self.half, (1, 2))
        return images[:, : 2 * self.half[0] + 1, : 2 * self.half[1] + 1]

    def to_taps_adjoint(self, d_images: Array) -> Array:
        """Return the adjoint of `to_taps`, the complex gradient by the spectra from that by the images.

        The real part of the sum of its conjugate times a change of the spectra is the change of the loss.
        """
        (n_v, n_u), (step_v, step_u) = self.fft_shape, self.steps
        padded = np.zeros((len(d_images), n_v // step_v, n_u // step_u))
        padded[:, : d_images.shape[1], : d_images.shape[2]] = d_images
        steps = np.zeros((len(d_images), n_v, n_u))
        steps[:, ::step_v, ::step_u] = np.roll(padded, (-self.half[0], -self.half[1]), (1, 2))
        d_spectra: Array = np.fft.rfft2(steps) / padded[0].size
        d_spectra[..., 1:-1] *= 2  # half of the spectrum of a real image is stored
        return d_spectra

    def gradient(self, d_images: Array) -> KernelShape:
        """Return the gradient by the shape, but for `curvature`, of a loss with the gradient `d_images` by the images."""
        d_spectra = self.to_taps_adjoint(d_images).real * self.pixel_by_spline
        f_v, f_u = self.frequencies
        scales, (a, b, c) = self.image_scales, self.sincs
        d_disc = d_spectra * a * b * c * self._discs[1]
        d_scales = (d_disc * self.radius).sum(axis=(1, 2))
        # The radius is the root of a sum of squares: its derivatives have the radius as divisor.
        d_radius = (d_disc * (1 + scales)).sum(axis=0)
        d_radius = np.divide(d_radius, self.radius, out=0 * self.radius, where=self.radius > 0)
        diameters = zip(self.shape.hole_diameter, self.frequencies, strict=True)
        d_diameter = np.array([diameter * (d_radius * f**2).sum() for diameter, f in diameters])
        d_edges, d_shadow = np.empty((2, 3)), d_spectra * self._discs[0]
        for i, (other_sincs, wave) in enumerate(zip((b * c, a * c, a * b), self.waves, strict=True)):
            d_wave = d_shadow * other_sincs * _sinc_derivative(scales * wave)
            d_scales += (d_wave * wave).sum(axis=(1, 2))
            d_wave = (d_wave * scales).sum(axis=0)
            d_edges[:, i] = (d_wave * f_v).sum(), (d_wave * f_u).sum()
        # The scales of the two outermost planes are extrapolated from the others.
        d_scales[1:3] += np.array([2, -1]) * d_scales[0]
        d_scales[-3:-1] += np.array([-1, 2]) * d_scales[-1]
        return KernelShape(d_diameter, d_scales[1:-1], d_edges, np.zeros(2))

    def kernel_taps(self, images: Array) -> KernelTaps:
        """Return the kernels of `images`, which have one plane more on either side."""
        kernels: Array = _plane_means(images) * self._second_order_factors()
        kernels -= self.smallest_tap
        is_used = kernels > 0
        kernels *= is_used
        sums = np.empty_like(kernels)
        for phase in self._phases():
            sums[phase] = kernels[phase].sum(axis=(1, 2), keepdims=True)
        kernels /= sums
        return KernelTaps(kernels, sums, is_used)

    def kernel_taps_gradient(self, d_kernels: Array, images: Array, taps: KernelTaps) -> tuple[Array, Array, Array]:
        """Return the gradients by the images, by `curvature` (2,) and by `smallest_tap` (planes,) from that by the kernels.

        `taps` is what `kernel_taps` has returned for the images.
        """
        d_taps = np.empty_like(taps.kernels)
        for phase in self._phases():  # a quotient by the sum has the derivative less its weighted mean
            mean = (d_kernels[phase] * taps.kernels[phase]).sum(axis=(1, 2), keepdims=True)
            d_taps[phase] = d_kernels[phase] - mean
        d_taps *= taps.is_used / taps.sums
        d_smallest_tap = -d_taps.sum(axis=(1, 2))
        squares_v, squares_u = self._squared_distances()
        d_factors = d_taps * _plane_means(images)
        d_curvature = np.array([(d_factors * squares_v[:, None]).sum(), (d_factors * squares_u).sum()])
        d_taps *= self._second_order_factors()
        d_images = np.zeros_like(images)
        d_images[1:-1] += d_taps * (7 / 6)
        d_images[2:] -= d_taps / 12
        d_images[:-2] -= d_taps / 12
        return d_images, d_curvature, d_smallest_tap

    def _squared_distances(self) -> list[Array]:
        """Return the squared distances, cells, of the taps from the central one, along v and u."""
        return [np.arange(-h, h + 1.0) ** 2 for h in self.half]

    def _second_order_factors(self) -> Array:
        """Return the factors (taps, taps) of the second-order term, 1 + c_v v^2 + c_u u^2."""
        squares_v, squares_u = self._squared_distances()
        return 1 + self.shape.curvature[0] * squares_v[:, None] + self.shape.curvature[1] * squares_u

    def _phases(self) -> list[tuple[slice, ...]]:
        """Return, for each place of a cell in a pixel, the taps with which cells of that place enter the pixels."""
        axes = zip(self.half, self.cells_per_pixel, strict=True)
        slices = [[slice((h - a) % step, None, step) for a in range(step)] for h, step in axes]
        return [(slice(None), *phase) for phase in itertools.product(*slices)]


def spline_transform(frequencies: Array, cells: int) -> Array:
    """Return the Fourier transform of the spline's blur that the kernels of pixels of so many `cells` undo.

    It is 1 for one cell: such pixels are parts, and the spline's blur is a part of the detector's, which acts on them.
    """
    return np.ones_like(frequencies) if cells == 1 else np.asarray(np.sinc(frequencies) ** 3)


def _fast_length(n: int) -> int:
    """Return the smallest even number >= n, n even, without prime factors above 5: such Fourier transforms are fast."""
    return next(length for length in itertools.count(n, 2) if 30**16 % length == 0)


def _sinc_derivative(x: Array) -> Array:
    """Return the derivative of ``numpy.sinc`` at x."""
    is_small = np.abs(x) < 1e-3
    divisor = np.where(is_small, 1.0, x)
    series = -(np.pi**2) / 3 * x * (1 - (np.pi * x) ** 2 / 10)
    return np.where(is_small, series, (np.cos(np.pi * x) - np.sinc(x)) / divisor)


def disc_transform(x: Array) -> tuple[Array, Array]:
    """Return the Fourier transform of a disc of diameter 1 and integral 1, ``2 J1(pi x) / (pi x)``, and its derivative.

    Both are interpolated by cubic pieces between the values and slopes of a table.
    """
    values, slopes, spacing = _disc_table(2 ** math.ceil(math.log2(max(16.0, float(x.max())))))
    place = x / spacing
    i = np.minimum(place.astype(np.intp), len(values) - 2)
    t = place - i
    y0, y1, slope0, slope1 = values[i], values[i + 1], slopes[i], slopes[i + 1]
    a, b = 2 * (y0 - y1) + slope0 + slope1, 3 * (y1 - y0) - 2 * slope0 - slope1
    return y0 + t * (slope0 + t * (b + t * a)), (slope0 + t * (2 * b + 3 * t * a)) / spacing


@functools.lru_cache(maxsize=8)
def _disc_table(end: int) -> tuple[Array, Array, float]:
    """Return a table of the Fourier transform of a disc of diameter 1, by frequency from 0 to `end`.

    The results are the values, 1 at 0, their slopes per step, and the step between frequencies.
    """
    ticks = np.linspace(0, end, 64 * end + 1)
    heights = np.cos(np.pi * (np.arange(4 * end) + 0.5) / (8 * end))  # of chords, by Gauss and Chebyshev
    weights = 1 - heights**2
    weights /= weights.sum()
    waves = np.pi * np.outer(ticks, heights)
    return np.cos(waves) @ weights, -np.sin(waves) @ (np.pi * heights * weights) / 64, 1 / 64
