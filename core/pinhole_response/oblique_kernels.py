"""Kernels that depend on the photons' direction: through the knife edge, and into the depth of the crystal.

Where the lines to a pixel pass up to some depth of the edge is an ellipse in the hole's plane. So what the hole lets
through is a sum of ellipses, each with the Fourier transform of a disc. A photon that is recorded at depth z in the crystal
would have met the plane at the mean depth elsewhere along its line: the deeper, the nearer to the axis, and the smaller is
the hole's shadow seen from there. Kernels are made for pixels at nodes, a lattice on the image, and those of a pixel are
mixed from the four nodes around it.
"""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from ..arrays import Array
from ..physics.aperture import KnifeEdge
from ..physics.crystal import recorded_depths
from ..physics.optics import Optics
from .pixel_kernels import Counts, KernelNumbers, Spectra, disc_transform, half_taps

# Attenuation in the edge beyond which what passes is not counted; nodes of Gauss in the crystal.
_MOST_PASSED, _DEPTHS = 7.5, 32
# Slopes up to which the edge is a cone's, by the cone's own: steeper lines count nothing.
_STEEPEST = 0.98
# Taps that are this small, by those inside the shadow, are left out: tails are wide. So are rows and columns at the rim
# where no tap is more than this, by the largest: ripples of the transform.
_LEAST, _STRAY = 3e-3, 3e-4


@dataclass(frozen=True)
class Passage:
    """What a module's image of a point depends on besides the hole's diameter and the collimator's length."""

    knife: KnifeEdge | None
    """The edge, where it is penetrated by path."""
    crystal_mu: float
    """1/mm, where photons are recorded at their depth; else 0."""
    thickness: float
    """The crystal's, mm."""
    mean_depth: float
    """At which the image's plane lies behind the crystal's front, mm,"""
    spread: float
    """and the standard deviation of the depths along the axis."""

    @classmethod
    def of(cls, optics: Optics, diameter: float, thickness: float) -> Self:
        """That of a module with a hole of a diameter and a crystal of a thickness, mm."""
        knife = None
        if optics.edge == "path":
            plate = optics.plate_thickness
            knife = KnifeEdge(diameter / 2, float(optics.aperture_mu), float(optics.tangent), plate and float(plate))
        if optics.depth_layers == 1:
            return cls(knife, 0.0, thickness, 0.0, 0.0)
        mu = float(optics.crystal_mu)
        return cls(knife, mu, thickness, *recorded_depths(mu, thickness))

    def of_hole(self, effective: float) -> Self:
        """The same of a hole of another effective diameter by Paix, mm."""
        if self.knife is None:
            return self
        depth = self.knife.tangent / self.knife.mu
        return replace(self, knife=replace(self.knife, radius=(math.hypot(effective, depth) - depth) / 2))

    @property
    def decay(self) -> float:
        """mm beyond the rim in which what passes along the axis falls by e."""
        return 0.0 if self.knife is None else self.knife.tangent / (2 * self.knife.mu)


class Slanted(NamedTuple):
    """What a pixel's kernel is made of besides `KernelNumbers`; lengths in cells, along v and u."""

    forms: Array
    """(n, 3): squared diameters of ellipses as forms f_v^2, f_u^2, f_v f_u,"""
    centers: Array
    """(n, 2): their middles,"""
    shares: Array
    """(n,): and their shares of what a disc of the hole's diameter would let pass."""
    shifts: Array
    """(k, 2): from the pixel to where photons would have been recorded at the mean depth,"""
    nearer: Array
    """(k,): how much smaller the hole is, times the part of its shadow that does not grow with l / h,"""
    weights: Array
    """(k,): and what of them is,"""
    mixed: Array
    """(2,): and the variances of what mixing from node to node does, between nodes and at them on the mean."""


def node_places(n: int, apart: int) -> Array:
    """Numbers of the pixels at the nodes along an axis of n pixels."""
    return np.arange(max(2, -(-(n - 1) // apart) + 1)) * float(apart)


def slanted(
    passage: Passage, diameter: float, length: float, sizes: Array, place: Array, share: float, steps: Array, apart: int
) -> Slanted:
    """That of a pixel at a place on the crystal, mm along v and u; cells' `sizes` are in mm, `steps` those of a pixel.

    `length` is that to the plane of the image. `share` is the power of the pixels' factors, as in `Zone`; `apart` are
    pixels from node to node.
    """
    slope = place / length
    steep = float(np.hypot(*slope))
    axis = slope / steep if steep > 0 else np.array([1.0, 0.0])
    parts, across, along, off = np.ones(1), np.full(1, diameter / 2), np.full(1, diameter / 2), np.zeros(1)
    if passage.knife is not None:
        soft = passage.decay / float(np.abs(sizes * steps).min())
        slope_of_edge = min(steep, _STEEPEST * passage.knife.tangent)
        parts, depths = _layers(passage.knife, slope_of_edge, min(round(6 + 10 * soft), 32))
        along, off, across = _ellipses(passage.knife, depths, steep, length)
    shares = parts * along * across / (diameter / 2) ** 2
    longer = along**2 - across**2
    forms = 4 * (across**2)[:, None, None] * np.eye(2) + 4 * longer[:, None, None] * np.outer(axis, axis)
    forms = forms / np.outer(sizes, sizes)
    shifts, nearer, weights, mixed = np.zeros((1, 2)), np.zeros(1), np.ones(1), np.zeros(2)
    if passage.crystal_mu:
        nodes, weights = _gauss(_DEPTHS)
        z = nodes * passage.thickness
        stretch = 1 + (z - passage.mean_depth) / length
        squared = 1 + (steep / stretch) ** 2
        rate = passage.crystal_mu * np.sqrt(squared)
        recorded = rate * np.exp(-rate * z) / -np.expm1(-rate * passage.thickness)
        weights = weights * passage.thickness * recorded / stretch**2
        weights = weights * ((1 + steep**2) / squared) ** (1.5 * share)  # of the pixel's direction, that of the photon
        nearer = 1 / stretch - 1
        shifts = nearer[:, None] * place / sizes
        mixed = np.average((nearer - np.average(nearer, 0, weights)) ** 2, 0, weights) * (apart * steps) ** 2 / 8
    each = np.stack([forms[:, 0, 0], forms[:, 1, 1], 2 * forms[:, 0, 1]], -1)
    return Slanted(each, np.outer(off, axis) / sizes, shares, shifts, nearer, weights, mixed)


def _layers(knife: KnifeEdge, slope: float, n: int) -> tuple[Array, Array]:
    """Shares of the photons that pass up to some depths of the edge, and these, mm along the axis."""
    rate = knife.mu * math.sqrt(1 + slope**2)
    solid = np.inf if knife.plate is None else rate * knife.plate
    nodes, weights = _gauss(n)
    most = min(_MOST_PASSED, solid)
    parts = most * weights * np.exp(-most * nodes)
    # The rest: what would pass the solid plate is counted inside the hole alone.
    return np.append(parts, math.exp(-most)), np.append(most * nodes, most + 0.5 if most < solid else 0.0) / rate


def _ellipses(knife: KnifeEdge, depths: Array, slope: float, length: float) -> tuple[Array, Array, Array]:
    """Of ellipses half the axis along the slope, by how much they are off the hole's middle there, and the other half axis.

    The lines meet in a point `length` behind the hole: their slopes differ from place to place.
    """
    found, most = [], _STEEPEST * knife.tangent
    slope = min(slope, most)
    for towards, across in ((slope, 0.0), (-slope, 0.0), (0.0, slope)):
        reach = knife.radius + 0 * depths
        for _ in range(6):
            along = (towards + reach / length).clip(-most, most)
            secant = np.sqrt((1 + along**2 + across**2) / (1 + slope**2))
            reach = knife.reach(depths / secant, along, across)
        found.append(reach)
    far, near, side = found
    return (far + near) / 2, (far - near) / 2, side


@functools.lru_cache(maxsize=8)
def _gauss(n: int) -> tuple[Array, Array]:
    """Nodes and weights from 0 to 1."""
    x, w = np.polynomial.legendre.leggauss(n)  # type: ignore[no-untyped-call]
    return (x + 1) / 2, w / 2


def node_kernels(numbers: KernelNumbers, steps: Counts, each: list[Slanted], shape: Counts) -> Array:
    """The kernels (planes, nodes along v, along u, taps, taps) of a lattice of nodes of a `shape`, row by row."""
    half = _half(numbers, steps, each)
    spectra, kernels = SlantedSpectra(numbers, steps, half, each, shape), []
    for spectrum in spectra.of_nodes():
        image = spectra.spatial(spectrum * spectra.common)
        kernels.append(_moved(spectra.of_pixels(image)[0], image[1:-1]))
    found = np.stack(kernels, axis=1)
    found *= spectra.totals[:, None, None]
    inside, is_used = [], (found > _STRAY * found.max()).any(axis=(0, 1))
    for axis, h in ((-1, half[0]), (-2, half[1])):
        used = np.flatnonzero(is_used.any(axis=axis))
        reach = min(max(h - used[0], used[-1] - h), h)
        inside.append(slice(h - reach, h + reach + 1))
    found = found[:, :, inside[0], inside[1]]
    return found.reshape(len(found), *shape, *found.shape[2:])


class NodesGradient:
    """A sum over nodes' kernels as a linear form of what these are made of: near some numbers, it changes as the sum does.

    `by` are the sum's derivatives by the kernels of `node_kernels`.
    """

    def __init__(self, numbers: KernelNumbers, steps: Counts, each: list[Slanted], shape: Counts, by: Array) -> None:
        half = _half(numbers, steps, each)
        self._given = steps, half
        spectra = SlantedSpectra(numbers, steps, half, each, shape)
        self._common = spectra.common
        more = [(0, 0), *((h - n // 2,) * 2 for h, n in zip(half, by.shape[-2:], strict=True))]
        self._waves, totals = [], []
        self._by_common, self._by_bend, self._by_least = np.zeros(spectra.common.shape), np.zeros(2), np.zeros(len(by))
        of_each = by.reshape(len(by), len(each), *by.shape[-2:]).swapaxes(0, 1)
        for given, spectrum, total in zip(of_each, spectra.of_nodes(), spectra.totals, strict=True):
            own, image = np.pad(given, more), spectra.spatial(spectrum * spectra.common)
            found = spectra.of_pixels(image)
            totals.append(np.vdot(own, _moved(found[0], image[1:-1])))
            by_kernel, by_inner = _moved_gradient(own * total, found[0], image[1:-1])
            by_image, by_bend, by_least = spectra.of_pixels_gradient(by_kernel, image, found)
            by_image[1:-1] += by_inner
            wave = spectra.by_spectra(by_image)
            self._by_common += (wave.conj() * spectrum).real
            self._by_bend += by_bend
            self._by_least += by_least
            self._waves.append(wave)
        self._by_totals = np.array(totals)

    def of_edges(self, numbers: KernelNumbers) -> float:
        """The form, but for a constant, where only `edges` are others."""
        return float(np.vdot(self._by_common, Spectra(numbers, *self._given).common))

    def __call__(self, numbers: KernelNumbers, each: list[Slanted], shape: Counts) -> float:
        """The form."""
        spectra = SlantedSpectra(numbers, *self._given, each, shape)
        total = self._by_totals @ spectra.totals + self._by_bend @ numbers.bend
        total += self._by_least @ spectra.least.ravel()
        for wave, spectrum in zip(self._waves, spectra.of_nodes(), strict=True):
            total += np.vdot(wave, spectrum * spectra.common).real
        return float(total)


def _half(numbers: KernelNumbers, steps: Counts, each: list[Slanted]) -> Counts:
    """Taps on each side of the middle one that all nodes need."""
    shifts = np.max([np.abs(own.shifts).max(axis=0) for own in each], axis=0)
    return half_taps(numbers._replace(hole=_widest(each)), steps, shifts)


def _moved(kernel: Array, image: Array) -> Array:
    """A kernel (planes, taps, taps) with the mean place of the image, from which the faint end of a tail was taken."""
    tilt = np.ones_like(kernel)
    for other in (2, 1):
        along, wanted = (each.sum(axis=other) / each.sum(axis=(1, 2))[:, None] for each in (kernel, image))
        taps = np.arange(along.shape[1]) - along.shape[1] // 2
        mean = (along * taps).sum(axis=1, keepdims=True)
        off = taps - mean
        missing = (wanted * taps).sum(axis=1, keepdims=True) - mean
        tilt += np.expand_dims(missing * off / (along * off**2).sum(axis=1, keepdims=True), other)
    return np.asarray(kernel * tilt.clip(min=0))


def _mean(of: Array, values: Array) -> Array:
    return np.asarray((of * values).sum(axis=(1, 2), keepdims=True) / of.sum(axis=(1, 2), keepdims=True))


def _moved_gradient(by: Array, kernel: Array, image: Array) -> tuple[Array, Array]:
    """Derivatives by the kernel and the image of `_moved`, from those by what it gives."""
    tilt, by_kernel, by_image = np.ones_like(kernel), np.zeros_like(kernel), np.zeros_like(image)
    places = []
    for axis in (1, 2):
        taps = np.expand_dims(np.arange(kernel.shape[axis]) - kernel.shape[axis] // 2, 2 - axis)
        off, off_image = taps - _mean(kernel, taps), taps - _mean(image, taps)
        spread, missing = _mean(kernel, off**2), _mean(image, off)
        tilt += missing * off / spread
        places.append((off, off_image, spread, missing))
    by_tilt = by * kernel * (tilt > 0)
    for off, off_image, spread, missing in places:
        first = (by_tilt * off).sum(axis=(1, 2), keepdims=True) / spread
        by_mean = -first - missing / spread * by_tilt.sum(axis=(1, 2), keepdims=True)
        by_kernel += by_mean * off - missing / spread * first * (off**2 - spread)
        by_image += first * off_image
    by_kernel /= kernel.sum(axis=(1, 2), keepdims=True)
    by_image /= image.sum(axis=(1, 2), keepdims=True)
    return by_kernel + by * tilt.clip(min=0), by_image


def _widest(each: list[Slanted]) -> Array:
    """The largest diameters of all ellipses, (2,)."""
    widest: Array = np.max([(np.sqrt(own.forms[:, :2]) + 2 * np.abs(own.centers)).max(axis=0) for own in each], axis=0)
    return widest


class SlantedSpectra(Spectra):
    """The spectra of nodes' images. What passes the hole is made for 3 x 3 of them, and is quadratic between these."""

    def __init__(self, numbers: KernelNumbers, steps: Counts, half: Counts, each: list[Slanted], shape: Counts) -> None:
        super().__init__(numbers, steps, half)
        self.each = each
        chosen, self.bases = zip(*(_quadratic(n) for n in shape), strict=True)
        self.holes = np.array([[self._hole(each[i * shape[1] + j]) for j in chosen[1]] for i in chosen[0]])
        passed = np.reshape([own.shares.sum() for own in each], shape)
        self.passed = self.bases[0] @ passed[np.ix_(*chosen)] @ self.bases[1].T
        exact = passed - sum(_second_difference(passed, axis) / 12 for axis in (0, 1))
        self.totals = exact.ravel() * [own.weights.sum() for own in each]

    @property
    def least(self) -> Array:
        """(planes, 1, 1): by what a tap would be if those in the widest shadow and a pixel were alike."""
        shadow = np.pi / 4 * _widest(self.each).prod() * (1 + self.numbers.slopes) ** 2
        return np.asarray(_LEAST / (shadow + math.prod(self.steps)))[:, None, None]

    def _hole(self, own: Slanted) -> Array:
        """What passes the hole; and with depths, how that grows with the shadow's part that is not l / h."""
        f_v, f_u = self.f
        total: Array = 0.0  # type: ignore[assignment]
        for form, center, share in zip(own.forms, own.centers, own.shares, strict=True):
            radius = np.sqrt(np.maximum(form[0] * f_v**2 + form[1] * f_u**2 + form[2] * f_v * f_u, 0))
            disc, rise = disc_transform((1 + self.slopes) * radius)
            disc = share * (np.stack([disc, radius * rise]) if own.nearer.any() else disc[None])
            if center.any():
                v, u = (np.exp(-2j * np.pi * (1 + self.slopes) * at * f) for at, f in zip(center, self.f, strict=True))
                disc = disc * v * u
            total = total + disc
        return total

    def _smear(self, own: Slanted) -> Array:
        """The spectrum of what the depth in the crystal does: to images, and as far as the hole's size is concerned."""
        waves = [np.exp(-2j * np.pi * np.outer(own.shifts[:, i], f.ravel())) for i, f in enumerate(self.f)]
        shares = np.stack([own.weights, own.weights * own.nearer]) / own.weights.sum()
        total: Array = (waves[0] * shares[:, :, None]).swapaxes(1, 2) @ waves[1]
        return total * (1 + 2 * np.pi**2 * (own.mixed[0] * self.f[0] ** 2 + own.mixed[1] * self.f[1] ** 2))

    def of_nodes(self) -> Iterator[Array]:
        """The spectra of the nodes' images, without `common`, one by one, row by row."""
        each = iter(self.each)
        for of_row, passed in zip(self.bases[0], self.passed, strict=True):
            row = _mixed(of_row, self.holes)
            for of_node, share in zip(self.bases[1], passed, strict=True):
                hole, smear = _mixed(of_node, row), self._smear(next(each)) / share
                total = hole[0] * smear[0]
                if len(hole) > 1:
                    total += hole[1] * smear[1]
                yield total


def _mixed(shares: Array, of: Array) -> Array:
    """The sum along the first axis, each by its share: faster than a product of matrices where they are few."""
    total: Array = of[0] * shares[0]
    for one, share in zip(of[1:], shares[1:], strict=True):
        total += one * share
    return total


def _second_difference(values: Array, axis: int) -> Array:
    if values.shape[axis] < 3:
        return np.zeros_like(values)
    ends = [(1, 1) if i == axis else (0, 0) for i in range(values.ndim)]
    return np.pad(np.diff(values, 2, axis=axis), ends, "edge")


def _quadratic(n: int) -> tuple[list[int], Array]:
    """Up to three of n nodes, and what each has to do with those between, (n, 3).

    Less what linear mixing between nodes adds on the mean.
    """
    if n < 3:
        return list(range(n)), np.eye(n)
    chosen = [0, (n - 1) // 2, n - 1]
    each = [np.prod([(np.arange(n) - b) / (a - b) for b in chosen if b != a], axis=0) for a in chosen]
    bases = np.stack(each, axis=-1)
    return chosen, bases - np.diff(bases[:3], 2, axis=0) / 12
