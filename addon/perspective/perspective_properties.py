"""The Perspective panel's settings: `Scene.mphdrr_perspective`."""

import bpy
from bpy.props import EnumProperty, IntProperty

from ..blender import choices

_UNIFORM = (
    ("K", "Magnification", "Evenly spaced in k, the magnification: densest near the pinhole, where a module sees most"),
    ("DEPTH", "Depth", "Evenly spaced in depth, along the principal ray"),
)


class PerspectiveSettings:
    """How volumes are put into a module's own coordinates; mixed into the scene's properties and into the operators."""

    planes: IntProperty(
        name="Planes", description="Of the frustum: each shows the volume's mean along the rays in its layer", default=12,
        min=1, soft_max=32, max=256,
    )  # fmt: skip
    uniform: EnumProperty(
        name="Evenly In", description="What the layers are evenly spaced in", items=choices.items({}, _UNIFORM),
        default="K",
    )  # fmt: skip
    cells: IntProperty(
        name="Cells in Depth", description="Layers of cells through which a volume is taken, one of each for every pixel",
        default=64, min=1, soft_max=256, max=2048,
    )  # fmt: skip


class PerspectiveProperties(PerspectiveSettings, bpy.types.PropertyGroup):
    """State of the Perspective panel."""


CLASSES = (PerspectiveProperties,)
