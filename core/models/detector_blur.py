"""The detector's own blur of emission images: of photons on the crystal, before pixels count them."""

import math
from typing import Any

from ..arrays import Floats
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics.crystal import gaussian_blur
from ..physics.energy_window import FWHM_PER_SIGMA

# Standard deviation of the spline that shares out points among cells, and the least one of a blur that may include it, in
# parts of pixels.
_SPLINE, _WIDE = 0.5, 0.67


def pixel_parts(model: Any, views: Views, grid: Grid) -> int:
    """Return the number of parts of a pixel's side to blur apart, as many as the module of `Emission` with most needs."""
    magnification = model.system.collimator_length / model.system.pinhole_distance
    hole = (0.0 if model.hole == "point" else model.effective_diameter) * (1 + magnification)
    voxel = float(grid.voxel_volume ** (1 / 3)) * magnification
    pixels = [(m, side) for m in range(len(views)) for side in model.crystal_pitch(views, m)]
    return max(
        _parts(_sigma(model, m) / side, float(hole[m]) / side, float(voxel[m]) / side, model.is_by_depth)
        for m, side in pixels
    )


def matrices(model: Any, views: Views, m: int, parts: int) -> tuple[Floats, Floats]:
    """Return the matrices that blur view m of `Emission`, (n_v, n_v parts) along v and (n_u, n_u parts) along u."""
    (pitch_u, pitch_v), (n_v, n_u), sigma = model.crystal_pitch(views, m), views.shape, _sigma(model, m)
    blurred = _SPLINE / parts if has_wide_blur(model, views, m, parts) else 0.0
    return gaussian_blur(n_v, sigma / pitch_v, parts, blurred), gaussian_blur(n_u, sigma / pitch_u, parts, blurred)


def has_wide_blur(model: Any, views: Views, m: int, parts: int = 1) -> bool:
    """Return whether the depth-dependent response leaves its spline's blur in pixels' parts, since they are blurred more."""
    shadow = model.effective_diameter[m] * (1 + model.system.collimator_length[m] / model.system.pinhole_distance[m])
    per_mm = parts / max(model.crystal_pitch(views, m))
    return bool(model.is_by_depth and _includes_spline(_sigma(model, m) * per_mm, shadow * per_mm))


def _includes_spline(sigma: float, shadow: float) -> bool:
    """Return whether a blur may include the spline's; it and the hole's shadow are in parts of pixels.

    The spline moves photons across the image's ends, too: 0.3 % of those of a small source there.
    """
    return sigma > _WIDE and 1 + 0.8 / sigma < 0.0155 * shadow**2


def _sigma(model: Any, m: int) -> float:
    """Return the standard deviation of module m's blur, mm on the crystal."""
    return float(model._optics_of(m).intrinsic_fwhm) / FWHM_PER_SIGMA


def _parts(sigma: float, hole: float, voxel: float, is_by_depth: bool) -> int:
    """Return the number of parts of a pixel's side to blur apart, so that at most 0.3 % of the counts are misplaced.

    Means over whole pixels no longer say where in a pixel an edge was. `sigma` is the blur's standard deviation, `hole` and
    `voxel` the widths of their shadows, all in pixels. The law was fitted to images of discs with such edges. More parts
    that include the spline cost less than parts of several cells.
    """
    width = math.hypot(hole, voxel)
    if sigma == 0:
        return 1
    is_narrow = sigma**1.5 < 0.003 * width
    variance = width**2 / 16 + sigma**2 + 1 / 12
    sharp = min(200 * sigma**0.8 / width, 3.9 / (sigma**0.4 * width**0.55))
    misplaced = sharp * (1 + voxel / (3 * sigma)) ** -0.55 - 0.5
    widened = 1.0 if is_narrow else (15 / (width**0.5 * variance)) ** 0.4
    least = min(max(math.ceil(max(misplaced, widened)), 2 if sigma < 0.7 and not is_narrow else 1), 10)
    counts = range(least, 2 * least + 1) if is_by_depth and least > 1 and sigma * least > _WIDE else ()
    return next((n for n in counts if _includes_spline(sigma * n, hole * n)), least)
