"""What of a projector's arguments looks wrong, though it may be meant: texts of warnings, each with its number."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..arrays import Floats32
from ..geometry.collimator import Construction
from ..physics.materials import APERTURES, attenuation
from ..volumes.volume import Volume

_MOST_THROUGH = 0.005
"""Share of the photons that may pass the solid plate without a word."""
_UNNAMED = ((140.5, 1.0),)  # Tc-99m's line, where no isotope is named
_ABOVE_BONE, _ABOVE_METALS = 2.0, 1.2
"""Times the coefficient of bone, which attenuates most in a body (metal has more, but not much room), and the largest one of
`APERTURES` (iridium's and platinum's are a little above gold's)."""


def coefficient_warnings(model: Any) -> Iterator[str]:
    """Of what attenuates photons of one model's energies."""
    most = max(_largest(model, metal) for metal in APERTURES)
    for name in ("aperture_mu", "crystal_mu"):
        value = np.max(0.0 if getattr(model, name) is None else getattr(model, name))
        if value > _ABOVE_METALS * most:
            yield f"{name} is {value:g} 1/mm, more than any material's at its energy ({most:.3g}): is it in 1/cm?"
    if model.plate_thickness is not None and model.wall_thickness is None:
        yield from _plate_warnings(model)
    if isinstance(model.mu, Volume):
        yield from mu_warnings(model.mu.array, model)


def _plate_warnings(model: Any) -> Iterator[str]:
    """Of what passes the solid plates, which only models with walls count."""
    shares = []
    for m in range(len(model.system)):
        optics = model.optics.of_modules(m, len(model.system))
        built = Construction(float(optics.plate_thickness), opening_angle=float(optics.opening_angle))
        shares.append(optics.through_plate(model.system[m : m + 1].collimators(built)[0]))
    worst = int(np.argmax(shares))
    if shares[worst] > _MOST_THROUGH:
        share, number = f"up to {100 * shares[worst]:.2g} %", model.system.numbers[worst]
        passing = f"{share} of those through the hole (module {number})"
        yield f"emission: photons through the solid plate beside the hole are not counted: {passing}"


def mu_warnings(mu: Floats32, model: Any) -> Iterator[str]:
    """Of what attenuates, 1/mm."""
    bone = _largest(model, "bone")
    if (high := mu[mu > _ABOVE_BONE * bone]).sum(dtype=float) > 0.5 * mu.sum(dtype=float):
        yield f"mu is {high.mean():.3g} 1/mm where most photons are lost, bone's is {bone:.3g}: is it in 1/cm?"


def _largest(model: Any, material: str) -> float:
    """A material's largest coefficient at the energies that are counted, 1/mm."""
    return max(attenuation(material, energy) for energy, _ in model.photon_lines or _UNNAMED)
