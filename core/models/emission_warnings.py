"""Warnings of settings, attenuation and images of an `Emission` that look wrong, though they may be meant.

The `model` of these functions is the `Emission`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..arrays import Floats32
from ..geometry.collimator import Construction
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics.materials import APERTURES, attenuation
from ..volumes.resampling import outside_warnings
from ..volumes.volume import Volume
from .photon_lines import mu_volumes
from .pixel_points import expected_error, shadow_edges

_LARGEST_PLATE_SHARE = 0.005
"""Share of the photons that may pass the solid plate without a warning."""
_DEFAULT_LINES = ((140.5, 1.0),)  # Tc-99m's line, where no isotope is named
_ABOVE_BONE, _ABOVE_METALS = 2.0, 1.2
"""Factors beyond which a coefficient is doubtful: of bone's, which attenuates most in a body but for a little metal, and
of the largest one of `APERTURES` (iridium's and platinum's are a little above gold's)."""


def coefficient_warnings(model: Any) -> Iterator[str]:
    """Yield a warning for each attenuation coefficient of a model that looks wrong."""
    largest = max(_largest_coefficient(model, metal) for metal in APERTURES)
    for name in ("aperture_mu", "crystal_mu"):
        value = np.max(0.0 if getattr(model, name) is None else getattr(model, name))
        if value > _ABOVE_METALS * largest:
            yield f"{name} is {value:g} 1/mm, more than any material's at its energy ({largest:.3g}): is it in 1/cm?"
    if model.plate_thickness is not None and model.wall_thickness is None:
        yield from _plate_warnings(model)
    if isinstance(model.mu, Volume):
        yield from mu_warnings(model.mu.array, model)


def _plate_warnings(model: Any) -> Iterator[str]:
    """Yield a warning if many photons pass the solid plates, which models with walls alone take into account."""
    shares = []
    for m in range(len(model.system)):
        optics = model.optics.of_modules(m, len(model.system))
        construction = Construction(float(optics.plate_thickness), opening_angle=float(optics.opening_angle))
        shares.append(optics.through_plate(model.system[m : m + 1].collimators(construction)[0]))
    m = int(np.argmax(shares))
    if shares[m] > _LARGEST_PLATE_SHARE:
        share, number = f"up to {100 * shares[m]:.2g} %", model.system.numbers[m]
        passing = f"{share} of those through the hole (module {number})"
        yield f"emission: photons through the solid plate beside the hole are not counted: {passing}"


def mu_warnings(mu: Floats32, model: Any) -> Iterator[str]:
    """Yield a warning if `mu`, 1/mm, is much larger than bone's where it attenuates most."""
    bone = _largest_coefficient(model, "bone")
    if (high := mu[mu > _ABOVE_BONE * bone]).sum(dtype=float) > 0.5 * mu.sum(dtype=float):
        yield f"mu is {high.mean():.3g} 1/mm where most photons are lost, bone's is {bone:.3g}: is it in 1/cm?"


def image_warnings(volume: Volume, views: Views, model: Any) -> Iterator[str]:
    """Yield a warning of activity below 0, of activity outside maps of mu, and of images that reach beyond the crystals."""
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if lowest < -0.1 * abs(highest):  # interpolation leaves smaller values below 0
        yield f"the activity is {lowest:g} to {highest:g} kBq/mL: what is below 0 makes counts below 0"
    yield from map_warnings(volume, model)
    if model.within_crystal:
        return
    system = model.system
    magnification = np.linalg.norm(views.detector_centers - views.sources, axis=1) / system.collimator_length
    steps = np.stack([views.u_steps, views.v_steps])
    sides = np.linalg.norm(steps, axis=2) * np.array(views.shape[::-1])[:, None] / magnification  # on the crystal, mm
    if beyond := int(np.any(sides > 1.001 * system.detector_side, axis=0).sum()):
        yield (
            f"{beyond} of {len(views)} images are wider than the crystal: pixels beside it count photons that nothing "
            "detects, unless within_crystal (Crystal's Side) leaves them out"
        )


def map_warnings(volume: Volume, model: Any, limit: float = 0.01) -> Iterator[str]:
    """Yield a warning if more than the share `limit` of an activity is outside the model's maps of mu."""
    for grid in dict.fromkeys(mu.grid for mu in mu_volumes(getattr(model, "mu", None))):
        yield from outside_warnings(volume, grid, "the map of mu", "where nothing attenuates its photons", limit)


def ray_caution(model: Any, views: Views, grid: Grid) -> str | None:
    """Return a warning if a model by rays has too few of them for its tolerance, or None."""
    edges = [shadow_edges(views, m, grid) for m in range(len(views))]
    points = [(model.pixel_points_needed(views, m, grid), model.hole_points(views, m, grid)) for m in range(len(views))]
    errors = [expected_error(edge, *numbers) for edge, numbers in zip(edges, points, strict=True)]
    error, module = max(errors), int(np.argmax(errors))
    if error <= model.tolerance:
        return None
    n, voxel = points[module][0], " x ".join(f"{size:.3g}" for size in grid.spacing)
    percent = "more than 100" if error > 1 else f"up to {100 * error:.2g}"
    advice = "take smaller pixels, or larger voxels"
    if model.pixel_points is not None:
        advice = f"pixel_points=None (--pixel-points auto) takes as many as keep {100 * model.tolerance:g} %"
    rays = f"{n} point{'s' * (n > 1)} of each pixel"
    off = f"{percent} % off (in module {model.system.numbers[module]}), those of larger sources less"
    return f"emission: with {rays} the total counts of a single voxel of {voxel} mm may be {off}; {advice}"


def _largest_coefficient(model: Any, material: str) -> float:
    """Return a material's largest attenuation coefficient, 1/mm, at the energies of the detected photons."""
    return max(attenuation(material, energy) for energy, _ in model.photon_lines or _DEFAULT_LINES)
