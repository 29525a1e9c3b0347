"""Position of a marker from its pixels in several views, its covariance, and tests of whether the pixels fit together.

References
----------
R. Hartley, A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., Cambridge University Press (2004), chapters
5 and 12.
R. D. Cook, S. Weisberg, "Residuals and Influence in Regression", Chapman and Hall (1982), section 2.2.
"""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import ArrayLike, Floats, Indexes
from ..errors import InputError
from ..geometry.frames import unit_vectors
from ..geometry.views import Views
from ..validation import freeze, lengths, real_array
from .view_rays import Indices, rays_by_depth, view_indices

_STEPS = 200
_HALVINGS = 40
# Shift of the pixels by a step, as a share of the largest column or row. Near its minimum, a step below the first limit
# changes the sum of squares by little more than rounding; a step below the second one is rounding.
_NEAR, _ROUNDING = 1e-6, 1e-11
_NO_PLACE = "triangulation: found no place in front of the sources; expected rays that meet there"
# Rays at a smaller angle, rad, have an intersection that rounding decides.
_LEAST_ANGLE = 1e-7


@dataclass(frozen=True, eq=False)
class MarkerFit:
    """Position of a marker by `fit_marker`, and its agreement with the pixels. Arrays of N are in the order of `modules`."""

    modules: Indexes  # (N,), indices of the views, from 0
    point: Floats  # (3,), most likely position, world mm
    covariance: Floats  # (3, 3), mm^2, covariance of the position: inverse of the Fisher information
    residuals: Floats  # (N, 2), measured pixels minus those of the position: columns and rows
    chi2: float  # sum of squared residuals in units of sigma
    degrees: int  # degrees of freedom of chi2: 2 N - 3
    p_value: float  # probability of at least this chi2 if sigma is right; a small one means that something does not fit
    misfits: Floats  # (N,), decrease of chi2 if a module is left out; NaN if there are only two
    misfit_p_values: Floats  # (N,), probability of at least this misfit if the pixel fits (chi2 with 2 degrees)

    @property
    def standard_deviations(self) -> Floats:
        """Standard deviations (3,), mm, of the position along x, y and z."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def worst(self) -> int | None:
        """Index in `modules` of the pixel that fits worst with the others; None for two modules, whose misfits are equal."""
        return None if len(self.modules) < 3 else int(self.misfits.argmax())


def triangulate(views: Views, modules: Indices, pixels: ArrayLike, sigma: ArrayLike = 1.0) -> Floats:
    """Return the most likely position (3,), world mm, of a point from its `pixels` in several views: that of the least chi2.

    Parameters and errors are those of `fit_marker`, whose `MarkerFit.point` this is. Only the ratios of sigmas matter.

    Examples
    --------
    >>> triangulate(views, [0, 3, 17], [(120.2, 131.0), (98.7, 140.3), (127.5, 127.5)])
    """
    return _fit(views, modules, pixels, sigma)[0]


def fit_marker(views: Views, modules: Indices, pixels: ArrayLike, sigma: ArrayLike = 1.0) -> MarkerFit:
    """Fit the position of a marker to its pixels in several views; return it with covariance and tests of the pixels.

    The sum of squared residuals, in units of sigma, is minimised by Gauss-Newton steps from the point nearest to all rays.
    Exact pixels give the point exactly.

    A pixel that is wrong by many sigma draws the position towards it, and all residuals grow. Therefore `MarkerFit.misfits`
    measures each residual by its own covariance, ``sigma_i - J_i C J_i^T``: to first order it is the decrease of chi2
    without this pixel.

    Parameters
    ----------
    views : Views
        Pinhole or parallel views.
    modules : array of int (N,)
        Indices of the views, from 0: two or more, each once.
    pixels : array (N, 2)
        Column and row of the marker in each.
    sigma : float or array (N,) or (N, 2, 2)
        Standard deviation of the pixels' columns and rows; or covariances of (column, row), px^2.

    Raises
    ------
    InputError
        There are fewer than two views, one of them twice, or a view that does not exist; the rays are parallel or meet
        behind a source; or sigma leaves the position unknown: its standard deviation exceeds its distance from a source.

    Examples
    --------
    >>> fit = fit_marker(views, [0, 3, 17], pixels, sigma=0.3)
    >>> fit.point, fit.standard_deviations, fit.p_value
    """
    point, index, residuals, whitening, derivatives = _fit(views, modules, pixels, sigma)
    information = np.einsum("nij,nik->jk", derivatives, derivatives)
    covariance = np.linalg.inv(information)
    covariance = (covariance + covariance.T) / 2
    largest_variance = float(np.linalg.eigvalsh(covariance)[-1])
    if not views.parallel:
        distance = float(np.linalg.norm(point - views.sources[index], axis=1).min())
        if not math.sqrt(largest_variance) < distance:
            size = f"{math.sqrt(largest_variance):.3g} mm at {distance:.3g} mm from a source"
            reason = f"the rays are so nearly parallel that sigma leaves the depth unknown, by {size}"
            raise InputError(f"triangulation: {reason}; expected views farther apart, or a smaller sigma")
    whitened = np.einsum("nij,nj->ni", whitening, residuals)
    chi2 = float((whitened**2).sum())
    misfits = np.full(len(index), np.nan)
    if len(index) > 2:
        # 1 - leverage: the covariance of each whitened residual after the fit.
        remaining = np.eye(2) - derivatives @ covariance @ derivatives.swapaxes(1, 2)
        misfits = np.einsum("ni,nij,nj->n", whitened, np.linalg.pinv(remaining, rcond=1e-9, hermitian=True), whitened)
    degrees = 2 * len(index) - 3
    fitted = freeze(index), freeze(point), freeze(covariance), freeze(residuals)
    p_value, misfit_p_values = _survival_probability(chi2, degrees), np.exp(-misfits / 2)
    return MarkerFit(*fitted, chi2, degrees, p_value, freeze(misfits), freeze(misfit_p_values))


def _fit(
    views: Views, modules: Indices, pixels: ArrayLike, sigma: ArrayLike
) -> tuple[Floats, Indexes, Floats, Floats, Floats]:
    """Return the most likely position of a marker with the terms of its residuals.

    These are position (3,), indices of the views (N,), residuals (N, 2) in pixels, whitening matrices (N, 2, 2), which scale
    residuals to variance 1, and derivatives (N, 2, 3) of the whitened pixels by the position.
    """
    index = view_indices(views, modules, "triangulation")
    if index.ndim != 1 or len(index) < 2:
        raise InputError(f"triangulation: expected two or more views, got {index.size}")
    unique, counts = np.unique(index, return_counts=True)
    if counts.max() > 1:
        repeated = f"view {unique[counts.argmax()]} {counts.max()} times"
        raise InputError(f"triangulation: expected each view once, got {repeated}")
    pixels = real_array(pixels, "pixels", (len(index), 2))
    whitening = _whitening(sigma, len(index))
    point = _nearest_to_rays(views, index, pixels)
    matrices = views[index].projection_matrices()
    largest_pixel = 1 + np.abs(pixels).max()
    origin = point  # steps relative to it are small and lose no digits
    offsets = matrices[:, :, :3] @ origin + matrices[:, :, 3]
    shift = np.zeros(3)
    if (state := _residuals(matrices, offsets, shift, pixels, whitening)) is None:
        position = f"behind the source of image {offsets[:, 2].argmin() + 1} of {len(index)}"
        expected = "the images of one point in front of all sources, as (column, row)"
        raise InputError(f"triangulation: the rays meet {position}; expected {expected}")
    last_change = math.inf
    for _ in range(_STEPS):
        residuals, derivatives = state
        step = np.linalg.lstsq(derivatives.reshape(-1, 3), residuals.ravel(), rcond=None)[0]
        change = np.abs(np.linalg.solve(whitening, (derivatives @ step)[..., None])).max() / largest_pixel
        is_near = change <= _NEAR
        if is_near and change >= last_change:
            if change > _ROUNDING:
                raise InputError(_NO_PLACE)
            break
        limit = math.inf if is_near else float((residuals**2).sum())
        for halving in range(_HALVINGS):
            next_state = _residuals(matrices, offsets, shift + step / 2**halving, pixels, whitening)
            if next_state is not None and float((next_state[0] ** 2).sum()) <= limit:
                break
        else:
            raise InputError(_NO_PLACE)
        shift, state, last_change = shift + step / 2**halving, next_state, change
        if change == 0:
            break
    else:
        raise InputError(_NO_PLACE)
    residuals, derivatives = state
    return origin + shift, index, np.linalg.solve(whitening, residuals[..., None])[..., 0], whitening, derivatives


def _residuals(
    matrices: Floats, offsets: Floats, shift: Floats, pixels: Floats, whitening: Floats
) -> tuple[Floats, Floats] | None:
    """Return the whitened residuals (N, 2) and the derivatives (N, 2, 3) of the whitened pixels at a position.

    The position is an origin, whose homogeneous pixels are `offsets` (N, 3), plus `shift` (3,). None if the position is
    behind a source.
    """
    homogeneous = matrices[:, :, :3] @ shift + offsets
    factor = homogeneous[:, 2:]
    if not (factor > 0).all():
        return None
    projected = homogeneous[:, :2] / factor
    derivatives = (matrices[:, :2, :3] - projected[:, :, None] * matrices[:, 2:, :3]) / factor[..., None]
    return np.einsum("nij,nj->ni", whitening, pixels - projected), whitening @ derivatives


def _nearest_to_rays(views: Views, index: Indexes, pixels: Floats) -> Floats:
    """Return the point (3,), mm, with the smallest sum of squared distances from the pixels' rays."""
    starts, directions = rays_by_depth(views, index, pixels)
    directions = unit_vectors(directions)
    angle = float(np.linalg.norm(np.cross(directions[:, None], directions[None]), axis=-1).max())
    if angle < _LEAST_ANGLE:
        reason = f"the rays are parallel to {angle:.1g} rad, so the depth of the point is unknown"
        raise InputError(f"triangulation: {reason}; expected views from different directions")
    projections = np.eye(3) - directions[:, :, None] * directions[:, None]
    center = starts.mean(axis=0)
    # Solved by least squares, not by normal equations, since rays may be nearly parallel.
    rows = np.einsum("nij,nj->ni", projections, starts - center)
    return np.asarray(center + np.linalg.lstsq(projections.reshape(-1, 3), rows.ravel(), rcond=None)[0])


def _whitening(sigma: ArrayLike, n: int) -> Floats:
    """Return matrices (n, 2, 2) that scale residuals of covariance `sigma` to variance 1."""
    if np.ndim(sigma) == 3:
        covariances = real_array(sigma, "sigma", (n, 2, 2))
        scale = np.abs(covariances).max(axis=(1, 2))
        asymmetric = np.abs(covariances[:, 0, 1] - covariances[:, 1, 0]) > 1e-9 * scale
        smallest = np.linalg.eigvalsh(covariances)[:, 0]
        bad = asymmetric | ~(smallest > 1e-12 * scale)
        if bad.any():
            raise InputError(f"sigma: expected covariances, symmetric and above 0; {int(bad.argmax())} is not")
        return np.linalg.inv(np.linalg.cholesky(covariances))
    return np.eye(2) / lengths(sigma, "sigma", n, "px")[:, None, None]


def _survival_probability(chi2: float, degrees: int) -> float:
    """Return the probability of at least `chi2` for an odd number of degrees of freedom (Abramowitz and Stegun 26.4.4)."""
    half = chi2 / 2
    total = math.erfc(math.sqrt(half))
    for i in range(1, (degrees - 1) // 2 + 1):
        if half > 0:
            total += math.exp((i - 0.5) * math.log(half) - half - math.lgamma(i + 0.5))
    return min(total, 1.0)
