"""What a design makes as large as it can: sensitivity, detail, lesions and regions, each with its gradient.

An objective is called with a system and gives its value and the gradient (M, 15) by the rows of `numbers`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..physics.performance import Modules, resolution, sensitivity
from ..projector import Emission, Projector, geometry_gradient
from .numbers import differences, parts_of, row_gradient, rows_of
from .solvers import scipy_module

ModelOf = Callable[[PinholeSystem], Emission]
Valued = tuple[float, Floats]

_SHARPNESS = -8.0
"""Power of the mean that stands for the worst case: of n cases it is above the worst by n^(1/8) at most."""


def ball_points(radius: float, n: int) -> Floats:
    """The isocentre and n - 1 points (n, 3), mm, that fill a ball evenly: a spiral by the golden angle, shell by shell."""
    index = np.arange(n)
    z = 1 - 2 * ((index * (math.sqrt(2) - 1)) % 1)
    angle, across = index * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - z**2)
    distance = radius * (index / max(n - 1, 1)) ** (1 / 3)
    return distance[:, None] * np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


@dataclass(frozen=True, eq=False)
class _AtPoints:
    """The sum over modules, and mean over points (P, 3), mm, of what each module tells of each point.

    All modules see all points: that they do is a constraint of its own, and a value that jumps has no gradient.
    """

    model_of: ModelOf
    points: Floats

    def __call__(self, system: PinholeSystem) -> Valued:
        """Value and gradient (M, 15)."""
        optics, everything = self.model_of(system).optics, np.full(len(system), np.inf)

        def told(rows: Floats) -> Floats:
            centers, frames, d, l, _ = parts_of(rows)
            modules = Modules(centers, frames, d, l, everything, system.detector_thickness)
            return self._told(modules, optics).mean(axis=0)

        rows = rows_of(system)
        return float(told(rows).sum()), differences(told, rows)

    def _told(self, modules: Modules, optics: Any) -> Floats:
        """(P, M)."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Sensitivity(_AtPoints):
    """Sensitivity at a stated resolution: ``sum of g (1 - w^2 / target^2)``, counts per decay.

    A module's photons, g per decay with a blur of FWHM w, are brought to the target resolution, mm, by a kernel of
    ``sqrt(target^2 - w^2)``, whose noise is inverse to its area. So this is the inverse variance of an image of the target
    resolution. As g grows with w^2, the best w is target / sqrt(2): J. A. Fessler, "Spatial resolution and noise tradeoffs
    in pinhole imaging system design: a density estimation approach", Optics Express 2 (1998) 237-253. A module whose blur
    exceeds the target counts as negative, so that there is a slope to follow.
    """

    target: float

    def _told(self, modules: Modules, optics: Any) -> Floats:
        fwhm = resolution(modules, self.points, optics=optics)
        return sensitivity(modules, self.points, optics=optics) * (1 - (fwhm / self.target) ** 2)


@dataclass(frozen=True, eq=False)
class Detail(_AtPoints):
    """Signal to noise, squared, of stripes or rods of `size` mm: ``sum of g MTF(1 / (2 size))^2``.

    The hole blurs as a uniform disc (MTF ``2 J1(x) / x``) or as a Gaussian of the same FWHM, the detector as a Gaussian. In
    the noise of a uniform background the ideal observer's SNR^2 of a sinusoid is in proportion to counts and to MTF^2 (H. H.
    Barrett, K. J. Myers, "Foundations of Image Science", 2004, chapter 13). Best are a Gaussian of FWHM 0.750 size, and a
    disc with ``d (1 + b / l) = 1.172 size``, where J1' is 0. Rods that a disc shows as gaps count as negative.
    """

    size: float
    hole: Literal["disc", "gaussian"] = "disc"

    def _told(self, modules: Modules, optics: Any) -> Floats:
        special = scipy_module("special")
        hole = resolution(modules, self.points, optics=optics, intrinsic_fwhm=0.0)
        squared = resolution(modules, self.points, optics=optics) ** 2
        x = math.pi * hole / (2 * self.size)
        disc: Any = 1.0
        if self.hole == "disc":
            disc, squared = 2 * special.j1(x) / x, squared - hole**2
        gaussian = np.exp(-squared * (math.pi / (4 * self.size)) ** 2 / math.log(2))
        return sensitivity(modules, self.points, optics=optics) * disc * abs(disc) * gaussian**2


@dataclass(frozen=True, eq=False)
class _OfImages:
    """What the expected images of bodies tell of parts: volumes of activity (n_x, n_y, n_z) on a grid."""

    projector_of: Callable[[PinholeSystem], Projector]
    bodies: Sequence[Array]
    parts: Sequence[Array]
    worst: bool = False

    def __call__(self, system: PinholeSystem) -> Valued:
        """Value and gradient (M, 15)."""
        A = self.projector_of(system)
        bodies = [np.asarray(A(body), np.float64) + A.background for body in self.bodies]
        # Where nothing is expected, nothing is told.
        inverse = [np.divide(1.0, body, out=np.zeros_like(body), where=body > 1e-12 * body.max()) for body in bodies]
        parts = np.stack([np.asarray(A(part), np.float64) for part in self.parts])
        value, weights_of_parts, weights_of_bodies = self._told(parts, inverse)
        weights = np.stack([*weights_of_parts, *weights_of_bodies])
        return value, row_gradient(geometry_gradient(A, np.stack([*self.parts, *self.bodies]), weights), A.views.shape)

    def _told(self, parts: Floats, inverse: list[Floats]) -> tuple[float, list[Floats], list[Floats]]:
        """The value, and its derivatives by the images of parts and of bodies; `inverse` is 1 / the latter."""
        raise NotImplementedError

    def _combined(self, values: Floats) -> tuple[float, Floats]:
        """The mean of cases, or a smooth stand-in for the worst, and its derivatives by them."""
        power = _SHARPNESS if self.worst else 1.0
        value = float(np.mean(values**power) ** (1 / power))
        return value, (values / value) ** (power - 1) / values.size


class Lesion(_OfImages):
    """Signal to noise of known lesions (the parts) in known bodies, as an ideal observer of the counts sees them.

    ``SNR^2 = sum of (Δλ)^2 / λ`` over all pixels, λ the counts expected of body and background (H. H. Barrett, K. J. Myers,
    "Foundations of Image Science", 2004, chapter 13). Of several lesions and bodies it is the mean, or the worst.
    """

    def _told(self, parts: Floats, inverse: list[Floats]) -> tuple[float, list[Floats], list[Floats]]:
        squared = np.array([[(part**2 * i).sum() for part in parts] for i in inverse])
        if squared.min() <= 0:
            raise InputError("lesion: no pixel sees it")
        value, by_snr = self._combined(np.sqrt(squared))
        by = by_snr / (2 * np.sqrt(squared))  # (bodies, lesions)
        of_parts = [2 * part * sum(b * i for b, i in zip(column, inverse, strict=True))
                    for part, column in zip(parts, by.T, strict=True)]  # fmt: skip
        of_bodies = [-(i**2) * np.tensordot(row, parts**2, 1) for row, i in zip(by, inverse, strict=True)]
        return value, of_parts, of_bodies


class Regions(_OfImages):
    """Precision with which the amplitudes of regions or rods (the parts) can be estimated together.

    1 / the root mean variance of the amplitudes, in units of the activities given: the bound of Cramér and Rao, by the
    Fisher matrix ``F_ij = sum of a_i a_j / λ`` with a_i the images of the regions (H. H. Barrett, K. J. Myers, "Foundations
    of Image Science", 2004, chapter 13). Of several bodies it is the mean, or the worst.
    """

    def _told(self, parts: Floats, inverse: list[Floats]) -> tuple[float, list[Floats], list[Floats]]:
        k = len(parts)
        flat = parts.reshape(k, -1)
        fisher = [(flat * i.ravel()) @ flat.T for i in inverse]
        if min(map(np.linalg.matrix_rank, fisher)) < k:
            raise InputError("regions: their images are not independent, so that their amplitudes cannot be told apart")
        covariances = [np.linalg.inv(matrix) for matrix in fisher]
        precisions = np.array([(np.trace(covariance) / k) ** -0.5 for covariance in covariances])
        value, by = self._combined(precisions)
        # The trace of F^-1 changes by -F^-2 : dF.
        scales = by * precisions**3 / (2 * k)
        by_fisher = [scale * c @ c for scale, c in zip(scales, covariances, strict=True)]
        pairs = list(zip(by_fisher, inverse, strict=True))
        of_parts = np.sum([2 * np.tensordot(g, parts, 1) * i for g, i in pairs], axis=0)
        return value, list(of_parts), [-(i**2) * (np.tensordot(g, parts, 1) * parts).sum(axis=0) for g, i in pairs]
