"""Physics presets: settings of SPECT counts that are chosen together, as entries of a recipe.

A preset names an isotope and the materials of aperture and crystal; their numbers come from `physics.isotopes` and
`physics.materials`, at the isotope's energies. Settings of an acquisition or of one camera stay unchanged: time, noise,
attenuation, the detector's own blur, the opening angle. To add a preset, add a row to `_ROWS`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_RESET = (
    *("isotope", "window", "aperture_points", "aperture_tolerance", "hole", "aperture_mu", "edge", "plate_thickness"),
    *("wall_thickness", "crystal_mu", "depth_layers", "within_cone", "within_walls", "within_crystal"),
)
"""Settings of the model that every preset decides; those that a preset does not give get their defaults."""

_REAL = {"within_cone": True, "within_walls": True, "within_crystal": True}
"""Settings of a hole of finite size in a plate, of walls, and of a crystal of finite size."""


@dataclass(frozen=True)
class Preset:
    """Settings of a model that are chosen together."""

    name: str
    """Name on the command line, such as "tc99m-tungsten-czt"."""
    label: str
    """Name in menus."""
    text: str
    """Help text of one line."""
    model: Mapping[str, Any]
    """Values by the settings' names in the table [model]."""

    @property
    def changes(self) -> dict[str, Any]:
        """Changes of a recipe for `Recipe.updated`; None removes a value."""
        values = {**dict.fromkeys(_RESET), "kind": "emission", **self.model}
        return {f"model.{name}": value for name, value in values.items()}


def _camera(isotope: str, aperture: str, crystal: str) -> Preset:
    """Return the preset of a real camera with these names of isotope and materials."""
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
"""Presets by name."""
