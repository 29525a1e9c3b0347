"""The place of a marker from its images in several views, how well it is known, and whether the images fit together.

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
from ..geometry.views import Views
from ..validation import freeze, lengths, real_array
from .view_rays import Indices, rays_by_depth, view_indices

_STEPS = 200
_HALVINGS = 40
# How far a step moves the images, as a share of the pixels' numbers: steps below the first change the sum of squares, which
# has its least value there, by little more than rounding; those below the second are rounding.
_NEAR, _ROUNDING = 1e-6, 1e-11
_NO_PLACE = "triangulation: found no place in front of the sources; expected rays that meet there"
# Rays that are less apart, rad, meet where rounding has them meet.
_LEAST_ANGLE = 1e-7


@dataclass(frozen=True, eq=False)
class MarkerFit:
    """A marker's place by `fit_marker`, and how its images fit. Arrays of N are in the order of `modules`."""

    modules: Indexes  # (N,), the views' indices, from 0
    point: Floats  # (3,), the most likely place, world mm
    covariance: Floats  # (3, 3), mm^2, of the place: the inverse of the Fisher information
    residuals: Floats  # (N, 2), the given pixels less those of the place: columns and rows
    chi2: float  # the residuals' sum of squares in units of sigma
    degrees: int  # of freedom of chi2: 2 N - 3
    p_value: float  # the chance of at least this chi2 if sigma is right: if it is small, something does not fit
    misfits: Floats  # (N,), by how much chi2 falls where a module is left out; NaN if there are only two
    misfit_p_values: Floats  # (N,), the chance of at least this misfit if the image fits (chi2 of 2 degrees)

    @property
    def standard_deviations(self) -> Floats:
        """The place's along x, y and z (3,), mm."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def worst(self) -> int | None:
        """Where in `modules` the image is that fits worst with the others; None for two modules, which say the same."""
        return None if len(self.modules) < 3 else int(self.misfits.argmax())


def triangulate(views: Views, modules: Indices, pixels: ArrayLike, sigma: ArrayLike = 1.0) -> Floats:
    """The most likely place (3,), world mm, of a point that views have at `pixels`: the one with the smallest chi2.

    Parameters and errors are those of `fit_marker`, whose place it is. Only the ratios of sigmas count.

    Examples
    --------
    >>> triangulate(views, [0, 3, 17], [(120.2, 131.0), (98.7, 140.3), (127.5, 127.5)])
    """
    return _fitted(views, modules, pixels, sigma)[0]


def fit_marker(views: Views, modules: Indices, pixels: ArrayLike, sigma: ArrayLike = 1.0) -> MarkerFit:
    """The most likely place of a marker from its images, its covariance, and how the images fit together.

    The sum of squares of the residuals, in units of sigma, is made smallest by Gauss and Newton's steps from the point that
    is nearest to all rays. Exact images give the point exactly.

    An image that is wrong by many sigma draws the place towards it, and all residuals grow. So `MarkerFit.misfits` measures
    each residual by its own covariance, ``sigma_i - J_i C J_i^T``: that is by how much chi2 falls without this image, to
    first order.

    Parameters
    ----------
    views : Views
        Pinhole or parallel ones.
    modules : array of int (N,)
        Indices of the views, from 0: two or more, each once.
    pixels : array (N, 2)
        Column and row of the marker in each.
    sigma : float or array (N,) or (N, 2, 2)
        Standard deviation of the pixels' columns and rows; or covariances of (column, row), px^2.

    Raises
    ------
    InputError
        Fewer than two views, one of them twice, or a view that does not exist; rays that are parallel or meet behind a
        source; a place that sigma leaves unknown, as its standard deviation is larger than its distance from a source.

    Examples
    --------
    >>> fit = fit_marker(views, [0, 3, 17], pixels, sigma=0.3)
    >>> fit.point, fit.standard_deviations, fit.p_value
    """
    point, index, residuals, whitening, slopes = _fitted(views, modules, pixels, sigma)
    information = np.einsum("nij,nik->jk", slopes, slopes)
    covariance = np.linalg.inv(information)
    covariance = (covariance + covariance.T) / 2
    along = float(np.linalg.eigvalsh(covariance)[-1])
    if not views.parallel:
        distance = float(np.linalg.norm(point - views.sources[index], axis=1).min())
        if not math.sqrt(along) < distance:
            unknown = f"the depth unknown, by {math.sqrt(along):.3g} mm at {distance:.3g} mm from a source"
            found = f"the rays are so nearly parallel that sigma leaves {unknown}"
            raise InputError(f"triangulation: {found}; expected views farther apart, or a smaller sigma")
    whitened = np.einsum("nij,nj->ni", whitening, residuals)
    chi2 = float((whitened**2).sum())
    misfits = np.full(len(index), np.nan)
    if len(index) > 2:
        own = np.eye(2) - slopes @ covariance @ slopes.swapaxes(1, 2)
        misfits = np.einsum("ni,nij,nj->n", whitened, np.linalg.pinv(own, rcond=1e-9, hermitian=True), whitened)
    degrees = 2 * len(index) - 3
    place = freeze(index), freeze(point), freeze(covariance), freeze(residuals)
    p_value, p_values = _chance(chi2, degrees), np.exp(-misfits / 2)
    return MarkerFit(*place, chi2, degrees, p_value, freeze(misfits), freeze(p_values))


def _fitted(
    views: Views, modules: Indices, pixels: ArrayLike, sigma: ArrayLike
) -> tuple[Floats, Indexes, Floats, Floats, Floats]:
    """Place, views, residuals (N, 2), matrices (N, 2, 2) that make their variance 1, and slopes (N, 2, 3) after these."""
    index = view_indices(views, modules, "triangulation")
    if index.ndim != 1 or len(index) < 2:
        raise InputError(f"triangulation: expected two or more views, got {index.size}")
    kinds, counts = np.unique(index, return_counts=True)
    if counts.max() > 1:
        found = f"view {kinds[counts.argmax()]} {counts.max()} times"
        raise InputError(f"triangulation: expected each view once, got {found}")
    pixels = real_array(pixels, "pixels", (len(index), 2))
    whitening = _whitening(sigma, len(index))
    point = _nearest_to_rays(views, index, pixels)
    matrices = views[index].projection_matrices()
    largest = 1 + np.abs(pixels).max()
    center = point  # steps are small: counted from here, nothing cancels
    offsets = matrices[:, :, :3] @ center + matrices[:, :, 3]
    shift = np.zeros(3)
    state = _residuals(matrices, offsets, shift, pixels, whitening)
    if state is None:
        found = f"the rays meet behind the source of image {offsets[:, 2].argmin() + 1} of {len(index)}"
        expected = "the images of one point in front of all sources, as (column, row)"
        raise InputError(f"triangulation: {found}; expected {expected}")
    last = math.inf
    for _ in range(_STEPS):
        residuals, slopes = state
        step = np.linalg.lstsq(slopes.reshape(-1, 3), residuals.ravel(), rcond=None)[0]
        moved = np.abs(np.linalg.solve(whitening, (slopes @ step)[..., None])).max() / largest
        near = moved <= _NEAR
        if near and moved >= last:
            if moved > _ROUNDING:
                raise InputError(_NO_PLACE)
            break
        most = math.inf if near else float((residuals**2).sum())
        for halving in range(_HALVINGS):
            taken = _residuals(matrices, offsets, shift + step / 2**halving, pixels, whitening)
            if taken is not None and float((taken[0] ** 2).sum()) <= most:
                break
        else:
            raise InputError(_NO_PLACE)
        shift, state, last = shift + step / 2**halving, taken, moved
        if moved == 0:
            break
    else:
        raise InputError(_NO_PLACE)
    residuals, slopes = state
    return center + shift, index, np.linalg.solve(whitening, residuals[..., None])[..., 0], whitening, slopes


def _residuals(
    matrices: Floats, offsets: Floats, shift: Floats, pixels: Floats, whitening: Floats
) -> tuple[Floats, Floats] | None:
    """For a place: pixels less its own, in units of sigma (N, 2), and slopes of its own (N, 2, 3); None behind a source."""
    homogeneous = matrices[:, :, :3] @ shift + offsets
    factor = homogeneous[:, 2:]
    if not (factor > 0).all():
        return None
    seen = homogeneous[:, :2] / factor
    slopes = (matrices[:, :2, :3] - seen[:, :, None] * matrices[:, 2:, :3]) / factor[..., None]
    return np.einsum("nij,nj->ni", whitening, pixels - seen), whitening @ slopes


def _nearest_to_rays(views: Views, index: Indexes, pixels: Floats) -> Floats:
    """The point with the smallest sum of squared distances from the pixels' rays."""
    starts, directions = rays_by_depth(views, index, pixels)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    angle = float(np.linalg.norm(np.cross(directions[:, None], directions[None]), axis=-1).max())
    if angle < _LEAST_ANGLE:
        found = f"the rays are parallel to {angle:.1g} rad, so nothing says how deep the point is"
        raise InputError(f"triangulation: {found}; expected views from different directions")
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    middle = starts.mean(axis=0)
    # By least squares, not by its normal equations: rays may be nearly parallel.
    rows = np.einsum("nij,nj->ni", across, starts - middle)
    return np.asarray(middle + np.linalg.lstsq(across.reshape(-1, 3), rows.ravel(), rcond=None)[0])


def _whitening(sigma: ArrayLike, n: int) -> Floats:
    """Matrices (n, 2, 2) that make residuals of covariance `sigma` ones of variance 1."""
    if np.ndim(sigma) == 3:
        covariances = real_array(sigma, "sigma", (n, 2, 2))
        scale = np.abs(covariances).max(axis=(1, 2))
        skewed = np.abs(covariances[:, 0, 1] - covariances[:, 1, 0]) > 1e-9 * scale
        least = np.linalg.eigvalsh(covariances)[:, 0]
        bad = skewed | ~(least > 1e-12 * scale)
        if bad.any():
            raise InputError(f"sigma: expected covariances, symmetric and above 0; {int(bad.argmax())} is not")
        return np.linalg.inv(np.linalg.cholesky(covariances))
    return np.eye(2) / lengths(sigma, "sigma", n, "px")[:, None, None]


def _chance(chi2: float, degrees: int) -> float:
    """The probability of at least `chi2` for an odd number of degrees of freedom (Abramowitz and Stegun 26.4.4)."""
    half = chi2 / 2
    total = math.erfc(math.sqrt(half))
    for i in range(1, (degrees - 1) // 2 + 1):
        if half > 0:
            total += math.exp((i - 0.5) * math.log(half) - half - math.lgamma(i + 0.5))
    return min(total, 1.0)
