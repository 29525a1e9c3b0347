"""How the parts of modules look, in Blender and in exported solids."""

from typing import Literal, NamedTuple

PartKind = Literal["collimator", "crystal"]


class Look(NamedTuple):
    """How a part is shown: linear RGBA colour, metallic and roughness from 0 to 1."""

    color: tuple[float, float, float, float]
    metallic: float
    roughness: float


LOOKS: dict[PartKind, Look] = {
    "collimator": Look((0.36, 0.39, 0.43, 1.0), metallic=0.85, roughness=0.42),  # tungsten: grey metal
    "crystal": Look((0.05, 0.22, 0.85, 0.85), metallic=0.0, roughness=0.12),  # scintillator: clear blue
}
