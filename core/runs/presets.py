"""Physics presets: settings of SPECT counts that are chosen together, as entries of a recipe.

A preset names an isotope, the aperture's material and the crystal's; their numbers are those of `physics.isotopes` and
`physics.materials`, at the isotope's energies. What belongs to an acquisition or to one camera stays as it is: time, noise,
attenuation, the detector's own blur, the opening angle.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_RESET = (
    *("isotope", "window", "aperture_points", "aperture_tolerance", "hole", "aperture_mu", "edge", "plate_thickness"),
    *("wall_thickness", "crystal_mu", "depth_layers", "within_cone", "within_walls", "within_crystal"),
)
"""Settings of the model that every preset decides: those that it does not give have their defaults."""

_REAL = {"within_cone": True, "within_walls": True, "within_crystal": True}
"""A hole with a size in a plate, with walls and a crystal of finite size."""


@dataclass(frozen=True)
class Preset:
    """Settings that are chosen together."""

    name: str  # such as "tc99m-tungsten-czt"
    label: str  # as menus show it
    text: str
    model: Mapping[str, Any]  # by the names of the table `model`

    @property
    def changes(self) -> dict[str, Any]:
        """What it changes in a recipe (`Recipe.updated`), None for what it takes away."""
        values = {**dict.fromkeys(_RESET), "kind": "emission", **self.model}
        return {f"model.{name}": value for name, value in values.items()}


def _camera(isotope: str, aperture: str, crystal: str) -> Preset:
    label = f"{isotope}, {aperture.capitalize()}, {crystal}"
    text = f"{isotope}'s photons through a hole in {aperture} into {crystal}, with the hole's size, edge and walls"
    name = f"{isotope.replace('-', '')}-{aperture}-{crystal}".lower()
    return Preset(name, label, text, {"isotope": isotope, "aperture_mu": aperture, "crystal_mu": crystal, **_REAL})


_ROWS = (
    Preset(
        "ideal",
        "Ideal Pinhole",
        "One photon per decay through the middle of the hole; nothing blurs, penetrates or is missed",
        {"hole": "point", "intrinsic_fwhm": None},
    ),
    _camera("Tc-99m", "tungsten", "CZT"),
    _camera("Tc-99m", "tungsten", "NaI"),
    _camera("Tc-99m", "lead", "NaI"),
    _camera("Tl-201", "tungsten", "CZT"),
    _camera("Tl-201", "tungsten", "NaI"),
    _camera("I-123", "tungsten", "CZT"),
    _camera("I-123", "tungsten", "NaI"),
    _camera("In-111", "tungsten", "NaI"),
    _camera("Lu-177", "tungsten", "NaI"),
)
PRESETS: Mapping[str, Preset] = {preset.name: preset for preset in _ROWS}
"""The presets by name."""
