"""Kernels that depend on the photons' direction: through the knife edge, and into the depth of the crystal.

What lines of a slope s pass of the edge, up to some depth of it, is an ellipse in the hole's plane. So what the hole lets
through is a sum of ellipses, each with the Fourier transform of a disc. A photon that passes the hole at c is recorded at depth
z in the crystal, at s (l + z) - c: the image is that of a crystal at the mean depth, smeared along s. Kernels are made for
pixels at nodes, a lattice on the image, and those of a pixel are mixed from the four nodes around it.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from ..arrays import Array
from ..physics.aperture import KnifeEdge
from ..physics.crystal import recorded_depths
from ..physics.optics import Optics
from .hole_kernel import KernelNumbers, Spectra, disc_transform, half_taps, of_pixels

# Attenuation in the edge beyond which what passes is not counted, and nodes of Gauss up to there; nodes in the crystal.
_MOST_PASSED, _LAYERS, _DEPTHS = 6.5, 5, 32


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
        knife = optics.knife(diameter) if optics.edge == "path" else None
        if optics.depth_layers == 1:
            return cls(knife, 0.0, thickness, 0.0, 0.0)
        mu = float(optics.crystal_mu)
        return cls(knife, mu, thickness, *recorded_depths(mu, thickness))

    @property
    def is_plain(self) -> bool:
        """Whether the image depends on the hole's diameter and the collimator's length alone."""
        return self.knife is None and not self.crystal_mu


class Slanted(NamedTuple):
    """What a pixel's kernel is made of besides `KernelNumbers`; lengths in cells, along v and u."""

    forms: Array
    """(n, 3): squared diameters of ellipses as forms f_v^2, f_u^2, f_v f_u,"""
    shares: Array
    """(n,): and their shares of the photons."""
    shifts: Array
    """(k, 2): from the pixel to where photons would have been recorded at the mean depth,"""
    weights: Array
    """(k,): and what of them is,"""
    mixed: Array
    """(2,): and the variances of what mixing from node to node does, between nodes and at them on the mean."""


def node_places(n: int, apart: int) -> Array:
    """Numbers of the pixels at the nodes along an axis of n pixels."""
    return np.arange(max(2, -(-(n - 1) // apart) + 1)) * float(apart)


def slanted(
    passage: Passage, diameter: float, length: float, sizes: Array, place: Array, share: float, apart: Array
) -> Slanted:
    """That of a pixel at a place on the crystal, mm along v and u; cells' `sizes` are in mm.

    `length` is that to the plane of the image. `share` is the power of the pixels' factors, as in `Zone`; `apart` are cells
    from node to node.
    """
    slope = place / length
    steep = float(np.hypot(*slope))
    axis = slope / steep if steep > 0 else np.array([1.0, 0.0])
    parts, across, along = np.ones(1), np.full(1, diameter / 2), np.full(1, diameter / 2)
    if passage.knife is not None:
        parts, depths = _layers(passage.knife, steep)
        along, across = passage.knife.ellipse(depths, steep)
    shares = parts * along * across
    forms = 4 * (across**2)[:, None, None] * np.eye(2) + 4 * (along**2 - across**2)[:, None, None] * np.outer(axis, axis)
    forms = forms / np.outer(sizes, sizes)
    shifts, weights, mixed = np.zeros((1, 2)), np.ones(1), np.zeros(2)
    if passage.crystal_mu:
        nodes, weights = _gauss(_DEPTHS)
        z = nodes * passage.thickness
        stretch = 1 + (z - passage.mean_depth) / length
        squared = 1 + (steep / stretch) ** 2
        rate = passage.crystal_mu * np.sqrt(squared)
        recorded = rate * np.exp(-rate * z) / -np.expm1(-rate * passage.thickness)
        weights = weights * passage.thickness * recorded / stretch**2
        weights = weights * ((1 + steep**2) / squared) ** (1.5 * share)  # of the pixel's direction, that of the photon
        shifts = (1 / stretch - 1)[:, None] * place / sizes
        mean = np.average(1 / stretch, 0, weights)
        mixed = np.average((1 / stretch - mean) ** 2, 0, weights) * apart**2 / 8
    each = np.stack([forms[:, 0, 0], forms[:, 1, 1], 2 * forms[:, 0, 1]], -1)
    return Slanted(each, shares / shares.sum(), shifts, weights, mixed)


def _layers(knife: KnifeEdge, slope: float) -> tuple[Array, Array]:
    """Shares of the photons that pass up to some depths of the edge, and these, mm along the axis."""
    rate = knife.mu * math.sqrt(1 + slope**2)
    solid = np.inf if knife.plate is None else rate * knife.plate
    nodes, weights = _gauss(_LAYERS)
    least = math.exp(-min(_MOST_PASSED, solid) / 3)
    root = least + (1 - least) * nodes  # of what passes
    through = 0.0 if knife.plate is None else math.exp(-solid)
    parts = 3 * root**2 * weights * (1 - least)
    return np.append(parts, through), np.append(-3 * np.log(root), 0.0) / rate


@functools.lru_cache(maxsize=8)
def _gauss(n: int) -> tuple[Array, Array]:
    """Nodes and weights from 0 to 1."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def node_kernels(numbers: KernelNumbers, steps: tuple[int, int], each: list[Slanted], shape: tuple[int, int]) -> Array:
    """The kernels (planes, nodes along v, along u, taps, taps) of a lattice of nodes of a `shape`, row by row."""
    half = _half(numbers, steps, each)
    spectra = SlantedSpectra(numbers, steps, half, each, shape)
    found = [of_pixels(spectra.image(i), numbers, steps, half)[0] * own.weights.sum() for i, own in enumerate(each)]
    return np.stack(found, axis=1).reshape(len(found[0]), *shape, *found[0].shape[1:])


def _half(numbers: KernelNumbers, steps: tuple[int, int], each: list[Slanted]) -> tuple[int, int]:
    """Taps on each side of the middle one that all nodes need."""
    widest = np.sqrt(np.max([own.forms[:, :2].max(axis=0) for own in each], axis=0))
    return half_taps(numbers._replace(hole=widest), steps, np.max([np.abs(own.shifts).max(axis=0) for own in each], axis=0))


class SlantedSpectra(Spectra):
    """The spectra of nodes' images. What passes the hole is made for 3 x 3 of them, and is quadratic between these."""

    def __init__(
        self, numbers: KernelNumbers, steps: tuple[int, int], half: tuple[int, int], each: list[Slanted], shape: tuple[int, int]
    ) -> None:
        super().__init__(numbers, steps, half)
        self.each, self.common = each, self.pixel * self.sincs[0] * self.sincs[1] * self.sincs[2]
        chosen, bases = zip(*(_quadratic(n) for n in shape), strict=True)
        self.holes = np.array([[self._hole(each[i * shape[1] + j]) for j in chosen[1]] for i in chosen[0]])
        self.bases = np.einsum("ik,jl->ijkl", *bases).reshape(len(each), -1)

    def _hole(self, own: Slanted) -> Array:
        f_v, f_u = self.f
        total: Array = 0.0  # type: ignore[assignment]
        for form, share in zip(own.forms, own.shares, strict=True):
            radius = np.sqrt(np.maximum(form[0] * f_v**2 + form[1] * f_u**2 + form[2] * f_v * f_u, 0))
            total = total + share * disc_transform((1 + self.slopes) * radius)[0]
        return total

    def smear(self, own: Slanted) -> Array:
        """The spectrum of what the depth in the crystal does."""
        waves = [np.exp(-2j * np.pi * np.outer(own.shifts[:, i], f.ravel())) for i, f in enumerate(self.f)]
        total: Array = (waves[0] * (own.weights / own.weights.sum())[:, None]).T @ waves[1]
        return total * (1 + 2 * np.pi**2 * (own.mixed[0] * self.f[0] ** 2 + own.mixed[1] * self.f[1] ** 2))

    def image(self, i: int) -> Array:
        """A node's, (planes + 2, taps, taps)."""
        hole = np.tensordot(self.bases[i], self.holes.reshape(-1, *self.common.shape), 1)
        return self.spatial(self.common * hole * self.smear(self.each[i]))


def _quadratic(n: int) -> tuple[list[int], Array]:
    """Up to three of n nodes, and what each has to do with those between, (n, 3)."""
    if n < 4:
        return list(range(n)), np.eye(n)
    chosen = [0, (n - 1) // 2, n - 1]
    others = [[b for b in chosen if b != a] for a in chosen]
    return chosen, np.stack([np.prod([(np.arange(n) - b) / (a - b) for b in own], axis=0)
                             for a, own in zip(chosen, others, strict=True)], -1)  # fmt: skip
