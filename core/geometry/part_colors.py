"""Colours and surfaces of the parts of modules, in Blender and in exported solids."""

from typing import Literal, NamedTuple

PartKind = Literal["collimator", "crystal", "source", "panel"]


class Look(NamedTuple):
    """Surface of a part as it is rendered."""

    color: tuple[float, float, float, float]  # linear RGBA, 0 to 1
    metallic: float  # 0 to 1
    roughness: float  # 0 to 1


LOOKS: dict[PartKind, Look] = {
    "collimator": Look((0.36, 0.39, 0.43, 1.0), metallic=0.85, roughness=0.42),  # tungsten: grey metal
    "crystal": Look((0.05, 0.22, 0.85, 0.85), metallic=0.0, roughness=0.12),  # scintillator: clear blue
    "source": Look((0.85, 0.45, 0.05, 1.0), metallic=0.3, roughness=0.4),  # the tube of an X-ray source: orange
    "panel": Look((0.08, 0.45, 0.30, 0.6), metallic=0.0, roughness=0.3),  # an X-ray detector, translucent: green
}
