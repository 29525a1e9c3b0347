"""Settings of the Perspective panel, `Scene.mphdrr_perspective`, and of Epipolar Lines, `Scene.mphdrr_epipolar`."""

import bpy
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty

from ..blender import choices
from ..blender.updates import on_edit
from . import epipolar

_UNIFORM = (
    ("K", "Magnification", "Evenly spaced in k, the magnification: densest near the pinhole, where a module sees most"),
    ("DEPTH", "Depth", "Evenly spaced in depth, along the principal ray"),
)


class PerspectiveSettings:
    """Properties of a module's own coordinates, shared by the scene's settings (the panel) and the operators."""

    planes: IntProperty(name="Planes",
                        description="Number of planes; each shows the volume's mean along the rays in its layer",
                        default=12, min=1, soft_max=32, max=256)  # fmt: skip
    uniform: EnumProperty(name="Evenly In", description="Coordinate in which the layers are evenly spaced",
                          items=choices.items({}, _UNIFORM), default="K")  # fmt: skip
    cells: IntProperty(name="Cells in Depth", description="Number of layers of cells, with a cell for every pixel",
                       default=64, min=1, soft_max=256, max=2048)  # fmt: skip


class PerspectiveProperties(PerspectiveSettings, bpy.types.PropertyGroup):
    """State of the Perspective panel."""


def _range(settings: bpy.types.PropertyGroup) -> tuple[float, float]:
    """Return k at the front and at the back of the ROI; (0, 0) where no pixel is picked."""
    picked, _ = epipolar.picked_or_problem(settings.id_data)
    return (0.0, 0.0) if picked is None else picked.k_range


def _along(settings: bpy.types.PropertyGroup) -> float:
    """Return the marker's position between the front (0) and the back (1) of the ROI, evenly in k."""
    front, back = _range(settings)
    return min(max((settings.k - front) / (back - front), 0.0), 1.0) if front != back else 0.0


def _set_along(settings: bpy.types.PropertyGroup, value: float) -> None:
    """Set the marker's position between the front (0) and the back (1) of the ROI, evenly in k."""
    front, back = _range(settings)
    if front != back:
        settings.k = front + value * (back - front)


class EpipolarProperties(bpy.types.PropertyGroup):
    """Pixel of the shown run, and a marker on its ray."""

    views: StringProperty(name="Views", description="Views with a picked pixel; empty: none", options={"HIDDEN"})
    module: IntProperty(name="Module", description="Number of the pixel's module", update=on_edit("epipolar"))
    column: FloatProperty(name="Column",
                          description="Column of the pixel as in the arrays, along +u; 0: the centre of pixel 0",
                          step=100, precision=2, update=on_edit("epipolar"))  # fmt: skip
    row: FloatProperty(name="Row", description="Row of the pixel as in the arrays, along +v; 0: the centre of pixel 0",
                       step=100, precision=2, update=on_edit("epipolar"))  # fmt: skip
    k: FloatProperty(
        name="k", description="Magnification of the marker in the picked module: the virtual detector's distance from the "
        "pinhole over the marker's depth", default=1.0, min=1e-6, step=1, precision=4, update=on_edit("epipolar"),
    )  # fmt: skip
    along: FloatProperty(name="Along Ray",
                         description="Position of the marker, evenly in k: 0 at the front of the ROI, 1 at its back",
                         subtype="FACTOR", min=0.0, max=1.0, get=_along, set=_set_along)  # fmt: skip


CLASSES = (PerspectiveProperties, EpipolarProperties)
