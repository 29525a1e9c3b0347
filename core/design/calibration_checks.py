"""Doubts about a calibration: what its sources, images and physics may have that the model does not."""

import math

import numpy as np

from ..arrays import Bools, Floats
from ..errors import warn
from ..models.emission import Emission
from .bundle import FittedGeometry
from .spots import Spots

_THICK = 2.0  # mm; in thicker crystals the depth of interaction moves oblique spots
_SIGNIFICANT = 5.0  # standard deviations
_MAX_WIDENING = 0.03  # of the spots' radii, relative to the hole's shadow
_CHI_SQUARES = 0.5, 2.0  # limits of the median


def warn_of_inputs(model: Emission, images: Floats) -> None:
    """Warn of crystals with a depth that the model leaves out, and of images that are no counts."""
    thickest = float(model.system.detector_thickness.max())
    if model.depth_layers == 1 and thickest > _THICK:
        remedy = "give the model crystal_mu and depth_layers, or modules with oblique spots move"
        warn(f"calibrate: model: crystals of {thickest:g} mm without their depth of interaction; {remedy}")
    if (fractional := images[images != np.rint(images)]).size:
        expected = f"expected counts, whole numbers, got {fractional[0]:g}"
        warn(f"calibrate: images: {expected}; standard deviations hold for counts that are not scaled")


def warn_of_fit(spots: Spots, used: Bools, geometry: FittedGeometry, chi_square: Floats) -> None:
    """Warn of spots that are not the model's: of another radius, wider the more magnified they are, or of other noise.

    `used` (K, M) is the mask of the spots that the fit used, `chi_square` (M,) that of the modules.
    """
    typical = float(np.nanmedian(chi_square)) if np.isfinite(chi_square).any() else 1.0
    if not _CHI_SQUARES[0] <= typical <= _CHI_SQUARES[1]:
        causes = "images that are no counts but scaled, or another source, edge or crystal than the model's"
        warn(f"calibrate: chi-square is {typical:.2g} in most modules, expected about 1: {causes}", 4)
    heights = np.einsum("mj,kmj->km", geometry.frames[:, 2], geometry.points[:, None] - geometry.centers)
    magnification = geometry.length / heights
    shadows = spots.model.hole_radius * (1 + magnification)
    weights = used / np.maximum(spots.covariance[..., 2, 2], 1e-12)
    ratio = float((weights * shadows * spots.values[..., 2]).sum() / (weights * shadows**2).sum())
    if abs(ratio - 1) > max(_MAX_WIDENING, _SIGNIFICANT / float(np.sqrt((weights * shadows**2).sum()))):
        causes = "the holes have another diameter, or photons pass their edge (aperture_mu, edge)"
        warn(f"calibrate: the spots are {ratio:.3g} times as wide as the holes' shadows: {causes}", 4)
    # Of the blur's square, what grows with the magnification's square, as the extent of a source does.
    squares = magnification**2 / np.maximum(spots.sigma / spots.sigma.max(), 1e-6) ** 2
    weights = used * spots.gain
    squares = squares - (weights * squares).sum() / max(weights.sum(), 1e-30)
    information = float((weights * squares**2).sum())
    slope = float((used * spots.score * squares).sum()) / max(information, 1e-30)
    if abs(slope) * information**0.5 > _SIGNIFICANT:
        variances = spots.model.source_variance, max(0.0, spots.model.source_variance + slope)
        stated_diameter, fitted_diameter = (math.sqrt(20 * variance) for variance in variances)
        balls = f"balls of {fitted_diameter:.2g} mm instead of {stated_diameter:g} mm"
        causes = f"sources are like {balls} (source_diameter)"
        change = "wider" if slope > 0 else "sharper"
        warn(f"calibrate: the more the spots are magnified, the {change} they are: {causes}", 4)
