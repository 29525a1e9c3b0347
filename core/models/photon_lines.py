"""Photons of several energies: the lines in an energy window, the attenuation of each, and a model of each."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ..arrays import is_tensor
from ..errors import InputError, warn
from ..physics.ct_numbers import hu_to_mu
from ..physics.energy_window import counted_lines
from ..physics.isotopes import Isotope, isotope
from ..recording import recorded_warnings
from ..validation import one_of, positive, real_array
from ..volumes.volume import Volume, require_quantity

Lines = Sequence[tuple[float, float]]
"""Energies, keV, and detected photons per decay of photon lines, in order of energy."""
Mu = Volume | tuple[Volume, ...]
"""Attenuation coefficients of all photons, or of each line."""


def checked_photons(model: Any) -> dict[str, Any]:
    """Return a model's settings of its photons, checked: `isotope`, `window`, `energy_fwhm` and `photon_lines`.

    Without an isotope there are none. `model` is an `Emission`.
    """
    one_of(model.lines, ("together", "apart"), "emission: lines")
    if model.isotope is None:
        for name, default in (("window", None), ("energy_fwhm", None), ("lines", "together")):
            if getattr(model, name) != default:
                raise InputError(f"emission: {name} needs an isotope")
        return {}
    source = model.isotope if isinstance(model.isotope, Isotope) else isotope(model.isotope)
    low, high = source.window if model.window is None else real_array(model.window, "emission: window", (2,)).tolist()
    fwhm = model.energy_fwhm
    if fwhm is not None and (fwhm := positive(fwhm, "emission: energy_fwhm")) >= 1:
        raise InputError(f"emission: energy_fwhm: expected a share of the energy, less than 1, got {fwhm:g}")
    if not source.lines_within(low, high) and (fwhm is not None or model.photons_per_decay is None):
        energies = ", ".join(f"{energy:g}" for energy, _ in source.lines)
        raise InputError(f"emission: {source.name} has no photons from {low:g} to {high:g} keV; its lines: {energies}")
    lines = counted_lines(source, (low, high), fwhm)
    return {"isotope": source, "window": (low, high), "energy_fwhm": fwhm, "photon_lines": lines}


def mu_volumes(mu: Mu | None) -> tuple[Volume, ...]:
    """Return the volumes of mu as a tuple, in the order of the lines; none without attenuation."""
    return tuple(mu) if isinstance(mu, list | tuple) else () if mu is None else (mu,)


def mu_from_volumes(volumes: Sequence[Volume]) -> Mu | None:
    """Return attenuation coefficients as a model takes them: None, one volume, or a tuple of one for each line."""
    return tuple(volumes) if len(volumes) > 1 else next(iter(volumes), None)


def require_one_per_line(count: int, lines: Lines, name: str, kind: str = "volume") -> None:
    """Raise `InputError` unless `count`, a number of volumes of mu or of another `kind`, is that of the lines.

    `name` is the setting, for the message.
    """
    if count != len(lines):
        energies = ", ".join(f"{energy:g}" for energy, _ in lines)
        s = "s" * (len(lines) > 1)
        of_lines = f"{len(lines)} {kind}{s}, of the line{s} at {energies} keV"
        expected = of_lines if lines else f"one {kind} without an isotope"
        raise InputError(f"{name}: expected {expected}, got {count}")


def checked_mu(mu: Any, lines: Lines) -> Mu | None:
    """Return the attenuation of photons of these lines, checked: one volume of mu or of CT numbers, or one of mu per line.

    With a single line CT numbers become its volume of mu.
    """
    if mu is None:
        return None
    is_single, volumes = not isinstance(mu, list | tuple), mu_volumes(mu)
    for volume in volumes:
        if not isinstance(volume, Volume):
            hint = "; tensors of it go to the projector, A(x, mu=...)" if is_tensor(volume) else ""
            raise InputError(f"emission: expected mu to be a Volume, got {type(volume).__name__}{hint}")
        require_quantity(volume.quantity, ("mu", "hu") if is_single and lines else ("mu",), "emission: mu")
        if volume.quantity == "mu" and volume.array.min() < 0:
            raise InputError(f"emission: mu must not be negative, got {volume.array.min():g} 1/mm")
    if not is_single:
        require_one_per_line(len(volumes), lines, "emission: mu")
    if len(lines) > 1:
        return mu if is_single else volumes
    return hu_to_mu(volumes[0], lines[0][0]) if volumes[0].quantity == "hu" else volumes[0]


def line_models(model: Any, lines: Lines) -> tuple[Any, ...]:
    """Return the model of each line's photons: with its energy alone, its attenuation, and its share of the photons."""
    total, mu = sum(photons for _, photons in lines), model.mu
    volumes = mu if isinstance(mu, tuple) else [mu] * len(lines)
    if isinstance(mu, Volume) and mu.quantity == "hu":
        with recorded_warnings() as texts:
            volumes = [hu_to_mu(mu, energy) for energy, _ in lines]
        for text in dict.fromkeys(texts):  # once, not for each line
            warn(text)
    return tuple(
        replace(
            model, isotope=replace(model.isotope, lines=((energy, photons),)), window=(energy, energy), energy_fwhm=None,
            lines="together", mu=volume, photons_per_decay=model.photons_per_decay * (photons / total), background=0.0,
        )
        for (energy, photons), volume in zip(lines, volumes, strict=True)
    )  # fmt: skip
