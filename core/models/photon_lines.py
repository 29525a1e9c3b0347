"""Photons of several energies: what attenuates each, and a model of each."""

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
"""Energies, keV, and photons per decay that are counted, in order of energy."""
Mu = Volume | tuple[Volume, ...]
"""What attenuates all photons, or those of each line."""


def checked_photons(model: Any) -> dict[str, Any]:
    """What a model of emission keeps of its photons: isotope, window, energy resolution, and the lines that are counted."""
    one_of(model.lines, ("together", "apart"), "emission: lines")
    if model.isotope is None:
        for name, default in (("window", None), ("energy_fwhm", None), ("lines", "together")):
            if getattr(model, name) != default:
                raise InputError(f"emission: {name} needs an isotope")
        return {}
    known = model.isotope if isinstance(model.isotope, Isotope) else isotope(model.isotope)
    low, high = known.window if model.window is None else real_array(model.window, "emission: window", (2,)).tolist()
    share = model.energy_fwhm
    if share is not None and (share := positive(share, "emission: energy_fwhm")) >= 1:
        raise InputError(f"emission: energy_fwhm: expected a share of the energy, less than 1, got {share:g}")
    if not known.lines_within(low, high) and (share is not None or model.photons_per_decay is None):
        energies = ", ".join(f"{energy:g}" for energy, _ in known.lines)
        raise InputError(f"emission: {known.name} has no photons from {low:g} to {high:g} keV; its lines: {energies}")
    lines = counted_lines(known, (low, high), share)
    return {"isotope": known, "window": (low, high), "energy_fwhm": share, "photon_lines": lines}


def each_mu(mu: Mu | None) -> tuple[Volume, ...]:
    """The volumes of mu, in order."""
    return tuple(mu) if isinstance(mu, list | tuple) else () if mu is None else (mu,)


def mu_of(volumes: Sequence[Volume]) -> Mu | None:
    """What attenuates: nothing, one volume, or one for each line."""
    return tuple(volumes) if len(volumes) > 1 else next(iter(volumes), None)


def require_each(count: int, lines: Lines, what: str, kind: str = "volume") -> None:
    """Refuse so many volumes of mu, or other `kind` of such, unless there is one for each line."""
    if count != len(lines):
        energies = ", ".join(f"{energy:g}" for energy, _ in lines)
        s = "s" * (len(lines) > 1)
        of_lines = f"{len(lines)} {kind}{s}, of the line{s} at {energies} keV"
        expected = of_lines if lines else f"one {kind} without an isotope"
        raise InputError(f"{what}: expected {expected}, got {count}")


def checked_mu(mu: Any, lines: Lines) -> Mu | None:
    """What attenuates photons of these lines: of mu one volume, or one for each line; or of CT numbers one.

    Of a single line it is its volume of mu.
    """
    if mu is None:
        return None
    is_one, volumes = not isinstance(mu, list | tuple), each_mu(mu)
    for volume in volumes:
        if not isinstance(volume, Volume):
            hint = "; tensors of it go to the projector, A(x, mu=...)" if is_tensor(volume) else ""
            raise InputError(f"emission: expected mu to be a Volume, got {type(volume).__name__}{hint}")
        require_quantity(volume.quantity, ("mu", "hu") if is_one and lines else ("mu",), "emission: mu")
        if volume.quantity == "mu" and volume.array.min() < 0:
            raise InputError(f"emission: mu must not be negative, got {volume.array.min():g} 1/mm")
    if not is_one:
        require_each(len(volumes), lines, "emission: mu")
    if len(lines) > 1:
        return mu if is_one else volumes
    return hu_to_mu(volumes[0], lines[0][0]) if volumes[0].quantity == "hu" else volumes[0]


def models_of_lines(model: Any, lines: Lines) -> tuple[Any, ...]:
    """The model of each line's photons: with its energy alone, what attenuates it, and its share of the photons."""
    total, mu = sum(photons for _, photons in lines), model.mu
    volumes = mu if isinstance(mu, tuple) else [mu] * len(lines)
    if isinstance(mu, Volume) and mu.quantity == "hu":
        with recorded_warnings() as texts:
            volumes = [hu_to_mu(mu, energy) for energy, _ in lines]
        for text in dict.fromkeys(texts):  # each once, not for each line
            warn(text)
    return tuple(
        replace(
            model, isotope=replace(model.isotope, lines=((energy, photons),)), window=(energy, energy), energy_fwhm=None,
            lines="together", mu=own, photons_per_decay=model.photons_per_decay * (photons / total), background=0.0,
        )
        for (energy, photons), own in zip(lines, volumes, strict=True)
    )  # fmt: skip
