"""Objectives of a design, which are maximised: sensitivity, detail, lesions and regions, each with its gradient.

An objective is called with a system and returns its value and the gradient (M, 15) by the modules' rows (`numbers`).
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
from .numbers import central_differences, module_rows, row_gradient, split_rows
from .solvers import scipy_module

ValueAndGradient = tuple[float, Floats]
_ImageGradients = tuple[float, list[Floats], list[Floats]]

_WORST_CASE_POWER = -8.0
"""Exponent of the power mean that stands for the worst case: of n cases, it exceeds the worst by n^(1/8) at most."""


def ball_points(radius: float, n: int) -> Floats:
    """Return n points (n, 3), mm, that fill a ball evenly: the isocentre, and a spiral by the golden angle, outwards."""
    index = np.arange(n)
    z = 1 - 2 * ((index * (math.sqrt(2) - 1)) % 1)
    angle, rho = index * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - z**2)
    distance = radius * (index / max(n - 1, 1)) ** (1 / 3)
    return distance[:, None] * np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1)


@dataclass(frozen=True, eq=False)
class _PointObjective:
    """Objective that is a sum over modules, and a mean over points, of a merit of each module at each point.

    Crystals are taken to be infinitely large, so that all modules see all points: that they really do is a constraint of its
    own, and a merit that jumps to 0 would have no gradient.
    """

    make_model: Callable[[PinholeSystem], Emission]
    """Function that returns the emission model of a system."""
    points: Floats
    """Points (P, 3), mm."""

    def __call__(self, system: PinholeSystem) -> ValueAndGradient:
        """Return value and gradient (M, 15)."""
        optics, detector_side = self.make_model(system).optics, np.full(len(system), np.inf)

        def module_merits(rows: Floats) -> Floats:
            """Return the mean merit (M,) of each module over the points."""
            centers, frames, d, l, _ = split_rows(rows)
            modules = Modules(centers, frames, d, l, detector_side, system.detector_thickness)
            return self._merits(modules, optics).mean(axis=0)

        rows = module_rows(system)
        return float(module_merits(rows).sum()), central_differences(module_merits, rows)

    def _merits(self, modules: Modules, optics: Any) -> Floats:
        """Return the merit (P, M) of each module at each point."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Sensitivity(_PointObjective):
    """Sensitivity at a stated resolution: ``sum of g (1 - w^2 / target^2)``, counts per decay.

    A module's photons, g per decay with a blur of FWHM w, are brought to the target resolution, mm, by a kernel of
    ``sqrt(target^2 - w^2)``, whose noise is inversely proportional to its area. The objective is therefore the inverse
    variance of an image of the target resolution. As g grows with w^2, the best w is target / sqrt(2): J. A. Fessler,
    "Spatial resolution and noise tradeoffs in pinhole imaging system design: a density estimation approach", Optics Express
    2 (1998) 237-253. A module whose blur exceeds the target has a negative merit, which keeps its gradient useful.
    """

    target: float
    """Resolution of the image, FWHM, mm."""

    def _merits(self, modules: Modules, optics: Any) -> Floats:
        """Return ``g (1 - w^2 / target^2)`` (P, M)."""
        fwhm = resolution(modules, self.points, optics=optics)
        return sensitivity(modules, self.points, optics=optics) * (1 - (fwhm / self.target) ** 2)


@dataclass(frozen=True, eq=False)
class Detail(_PointObjective):
    """Squared signal-to-noise ratio of stripes or rods of `size` mm: ``sum of g MTF(1 / (2 size))^2``.

    The hole's blur is a uniform disc (MTF ``2 J1(x) / x``) or a Gaussian of the same FWHM, the detector's a Gaussian. In the
    noise of a uniform background, the ideal observer's SNR^2 of a sinusoid is proportional to the counts and to MTF^2 (H. H.
    Barrett, K. J. Myers, "Foundations of Image Science", 2004, chapter 13). The optimum is a Gaussian of FWHM 0.750 size, or
    a disc with ``d (1 + b / l) = 1.172 size``, where J1' is 0. Where the disc's MTF is negative and rods appear as gaps, the
    merit is negative.
    """

    size: float
    """Width of a stripe or diameter of a rod, mm: half the period."""
    hole: Literal["disc", "gaussian"] = "disc"
    """Shape of the hole's blur."""

    def _merits(self, modules: Modules, optics: Any) -> Floats:
        """Return ``g MTF |MTF|`` (P, M): sensitivity g and modulation transfer of each point in each module."""
        special = scipy_module("special")
        hole_fwhm = resolution(modules, self.points, optics=optics, intrinsic_fwhm=0.0)
        gaussian_fwhm_squared = resolution(modules, self.points, optics=optics) ** 2
        x = math.pi * hole_fwhm / (2 * self.size)
        disc_mtf: Any = 1.0
        if self.hole == "disc":
            disc_mtf, gaussian_fwhm_squared = 2 * special.j1(x) / x, gaussian_fwhm_squared - hole_fwhm**2
        gaussian_mtf = np.exp(-gaussian_fwhm_squared * (math.pi / (4 * self.size)) ** 2 / math.log(2))
        return sensitivity(modules, self.points, optics=optics) * disc_mtf * abs(disc_mtf) * gaussian_mtf**2


@dataclass(frozen=True, eq=False)
class _ImageObjective:
    """Objective computed from expected images of `backgrounds` and `signals`, volumes (n_x, n_y, n_z) of activity."""

    make_projector: Callable[[PinholeSystem], Projector]
    """Function that returns the projector of a system."""
    backgrounds: Sequence[Array]
    """Bodies, each of which is a case; their expected counts are the variances λ."""
    signals: Sequence[Array]
    """Lesions to detect, or regions with amplitudes to estimate."""
    worst: bool = False
    """Whether the value is (about) that of the worst case instead of the mean of all cases."""

    def __call__(self, system: PinholeSystem) -> ValueAndGradient:
        """Return value and gradient (M, 15)."""
        A = self.make_projector(system)
        variances = [np.asarray(A(body), np.float64) + A.background for body in self.backgrounds]
        # Pixels without expected counts have no information.
        inverse_variances = [np.divide(1.0, v, out=np.zeros_like(v), where=v > 1e-12 * v.max()) for v in variances]
        signals = np.stack([np.asarray(A(signal), np.float64) for signal in self.signals])
        value, d_signals, d_backgrounds = self._value_and_gradients(signals, inverse_variances)
        volumes, weights = np.stack([*self.signals, *self.backgrounds]), np.stack([*d_signals, *d_backgrounds])
        return value, row_gradient(geometry_gradient(A, volumes, weights), A.views.shape)

    def _value_and_gradients(self, signals: Floats, inverse_variances: list[Floats]) -> _ImageGradients:
        """Return the objective and its gradients by each signal image and by each background image.

        `signals` are the signals' images (n, M, n_v, n_u), `inverse_variances` 1 / the backgrounds' expected counts.
        """
        raise NotImplementedError

    def _combine_cases(self, values: Floats) -> tuple[float, Floats]:
        """Return the mean of the cases' `values`, or a smooth stand-in for the lowest, and its derivatives by them."""
        power = _WORST_CASE_POWER if self.worst else 1.0
        value = float(np.mean(values**power) ** (1 / power))
        return value, (values / value) ** (power - 1) / values.size


class Lesion(_ImageObjective):
    """Signal-to-noise ratio of known lesions (the signals) in known bodies, for an ideal observer of the counts.

    ``SNR^2 = sum of (Δλ)^2 / λ`` over all pixels, with the expected counts Δλ of the lesion and λ of body and background (H.
    H. Barrett, K. J. Myers, "Foundations of Image Science", 2004, chapter 13). Each pair of lesion and body is a case.
    """

    def _value_and_gradients(self, signals: Floats, inverse_variances: list[Floats]) -> _ImageGradients:
        """Return the mean or worst SNR and its gradients, see `_ImageObjective`."""
        squared = np.array([[(signal**2 * i).sum() for signal in signals] for i in inverse_variances])
        if squared.min() <= 0:
            raise InputError("lesion: no pixel sees it")
        value, d_snr = self._combine_cases(np.sqrt(squared))
        d_squared = d_snr / (2 * np.sqrt(squared))  # (bodies, lesions)
        d_signals = [2 * signal * sum(d * i for d, i in zip(column, inverse_variances, strict=True))
                     for signal, column in zip(signals, d_squared.T, strict=True)]  # fmt: skip
        rows = zip(d_squared, inverse_variances, strict=True)
        return value, d_signals, [-(i**2) * np.tensordot(row, signals**2, 1) for row, i in rows]


class Regions(_ImageObjective):
    """Precision of the joint estimate of the amplitudes of regions or rods (the signals).

    1 / the root mean variance of the amplitudes, in units of the given activities. The variances are the Cramér-Rao bound by
    the Fisher matrix ``F_ij = sum of a_i a_j / λ``, with the regions' images a_i and the expected counts λ of a body (H. H.
    Barrett, K. J. Myers, "Foundations of Image Science", 2004, chapter 13). Each body is a case.
    """

    def _value_and_gradients(self, signals: Floats, inverse_variances: list[Floats]) -> _ImageGradients:
        """Return the mean or worst precision and its gradients, see `_ImageObjective`."""
        k = len(signals)
        flat = signals.reshape(k, -1)
        fisher = [(flat * i.ravel()) @ flat.T for i in inverse_variances]
        if min(map(np.linalg.matrix_rank, fisher)) < k:
            raise InputError("regions: their images are not independent, so that their amplitudes cannot be told apart")
        covariances = [np.linalg.inv(matrix) for matrix in fisher]
        precisions = np.array([(np.trace(covariance) / k) ** -0.5 for covariance in covariances])
        value, d_precision = self._combine_cases(precisions)
        # The differential of the trace of F^-1 is -F^-2 : dF.
        scales = d_precision * precisions**3 / (2 * k)
        d_fisher = [scale * c @ c for scale, c in zip(scales, covariances, strict=True)]
        pairs = list(zip(d_fisher, inverse_variances, strict=True))
        d_signals = np.sum([2 * np.tensordot(d, signals, 1) * i for d, i in pairs], axis=0)
        return value, list(d_signals), [-(i**2) * (np.tensordot(d, signals, 1) * signals).sum(axis=0) for d, i in pairs]
