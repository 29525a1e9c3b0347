"""Checks of attenuation coefficients that look wrong, though they may be meant: warnings, each with its number.

The `model` of these functions is an `Emission`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..arrays import Floats32
from ..geometry.collimator import Construction
from ..physics.materials import APERTURES, attenuation
from ..volumes.volume import Volume

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


def _largest_coefficient(model: Any, material: str) -> float:
    """Return a material's largest attenuation coefficient, 1/mm, at the energies of the detected photons."""
    return max(attenuation(material, energy) for energy, _ in model.photon_lines or _DEFAULT_LINES)
