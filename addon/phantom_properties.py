"""Settings of phantoms and volumes: what the operator asks for is what the object keeps."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    IntVectorProperty,
    PointerProperty,
    StringProperty,
)

from ..core.grid import Grid
from ..core.phantoms.derenzo import DerenzoPhantom
from ..core.volume import UNITS


class DerenzoSettings:
    """A Derenzo phantom's numbers; mixed into the operator and into the object's properties."""

    radius: FloatProperty(
        name="Radius", description="Radius of the phantom in mm", default=40.0, min=0.1, soft_max=200.0
    )
    rod_diameters: FloatVectorProperty(
        name="Rods", description="Rod diameter in mm of each of the six sectors; 0 leaves a sector empty",
        size=6, default=(8.0, 6.0, 5.0, 4.0, 3.0, 2.0), min=0.0, soft_max=30.0,
    )  # fmt: skip
    height: FloatProperty(name="Height", description="Length of the rods in mm", default=40.0, min=0.1, soft_max=400.0)
    activity: FloatProperty(
        name="Activity",
        description="Activity concentration in the rods in kBq/mL",
        default=100.0,
        min=1e-6,
        soft_max=1e4,
    )
    voxels: IntProperty(
        name="Voxels", description="Voxels along each side of the grid", default=128, min=4, soft_max=512, max=4096
    )
    voxel_size: FloatProperty(
        name="Voxel Size", description="Side of a voxel in mm; 0 fits the grid to the phantom", default=0.0, min=0.0,
        soft_max=10.0, precision=3,
    )  # fmt: skip

    def phantom(self) -> DerenzoPhantom:
        """The phantom; float32 settings are read as the decimal numbers that the user typed."""
        return DerenzoPhantom(
            typed(self.radius),
            tuple(typed(w) for w in self.rod_diameters),
            typed(self.height),
            typed(self.activity),
        )

    def grid(self) -> Grid:
        """The phantom's grid, in its own frame."""
        # One voxel is kept free all around, so that no rod touches the edge.
        fitted = max(2 * typed(self.radius), typed(self.height)) / max(1, self.voxels - 2)
        return Grid.centered((self.voxels,) * 3, typed(self.voxel_size) or fitted)

    def recipe(self) -> dict[str, Any]:
        """The settings as JSON can hold them."""
        phantom = self.phantom()
        return {
            "phantom": "derenzo",
            "radius_mm": phantom.radius,
            "rod_diameters_mm": list(phantom.rod_diameters),
            "height_mm": phantom.height,
            "activity_kBq_per_mL": phantom.activity,
        }

    def draw_settings(self, layout: bpy.types.UILayout) -> None:
        """Draw the numbers into a panel or a dialog."""
        column = layout.column(align=True)
        column.prop(self, "radius", text="Radius (mm)")
        column.prop(self, "height", text="Height (mm)")
        column.prop(self, "activity", text="kBq/mL")
        grid = layout.column(align=True)
        grid.use_property_split = False
        grid.label(text="Rod diameters (mm)")
        for first in (0, 3):
            row = grid.row(align=True)
            for k in range(first, first + 3):
                row.prop(self, "rod_diameters", index=k, text="")
        column = layout.column(align=True)
        column.prop(self, "voxels", text="Voxels per Side")
        column.prop(self, "voxel_size", text="Voxel Size (mm)")
        if self.voxel_size == 0:
            fitted = max(2 * self.radius, self.height) / max(1, self.voxels - 2)
            row = column.row()
            row.alignment = "RIGHT"
            row.active = False
            row.label(text=f"0 fits the grid: {fitted:.3g} mm")


class DerenzoProperties(DerenzoSettings, bpy.types.PropertyGroup):
    """What a Derenzo object was made from."""


# The modules that draw import these properties: they are imported when an edit calls for them.
def _range_changed(self: VolumeProperties, context: bpy.types.Context) -> None:
    from . import slices, volumes

    volumes.show_range(self.id_data)
    slices.update(self.id_data)


def _slices_changed(self: VolumeProperties, context: bpy.types.Context) -> None:
    from . import slices

    slices.update(self.id_data)


class VolumeProperties(bpy.types.PropertyGroup):
    """One volume; lives on its object as `Object.mphdrr_volume`."""

    is_volume: BoolProperty(name="Is Volume", options={"HIDDEN"})
    kind: EnumProperty(
        name="Kind", description="What the volume was made as",
        items=(("VOLUME", "Volume", "Voxels from elsewhere"), ("DERENZO", "Derenzo", "Derenzo phantom")),
    )  # fmt: skip
    quantity: EnumProperty(
        name="Quantity", description="What the voxels hold",
        items=tuple((name, name.capitalize(), f"In {unit}") for name, unit in UNITS.items()),
    )  # fmt: skip
    unit: StringProperty(name="Unit", description="Unit of the voxels' values")
    shape: IntVectorProperty(name="Shape", description="Voxels along the grid's axes", size=3)
    spacing: FloatVectorProperty(name="Spacing", description="Voxel size in mm along the grid's axes", size=3)
    minimum: FloatProperty(name="Minimum", description="Smallest voxel value")
    maximum: FloatProperty(name="Maximum", description="Largest voxel value")
    extent: FloatProperty(
        name="Extent", description="Largest side in mm of the box around what is not empty", options={"HIDDEN"},
        default=1.0,
    )  # fmt: skip
    display_low: FloatProperty(
        name="Low",
        description="Value, in the volume's unit, at and below which nothing is shown",
        update=_range_changed,
    )
    display_high: FloatProperty(
        name="High", description="Value, in the volume's unit, that is shown brightest", default=1.0,
        update=_range_changed,
    )  # fmt: skip
    slices: IntVectorProperty(
        name="Slices", description="Voxel, along each of the grid's axes, that the slice planes lie in; from 0", size=3,
        min=0, update=_slices_changed,
    )  # fmt: skip
    exact_pose: StringProperty(
        name="Exact Pose", description="World-from-object matrix in double precision, JSON", options={"HIDDEN"}
    )
    center_shift: FloatProperty(
        name="Centre Shift", description="Voxels by which the .vdb is shifted for the Blender that wrote it",
        options={"HIDDEN"},
    )  # fmt: skip
    derenzo: PointerProperty(name="Derenzo", type=DerenzoProperties)


def typed(value: float) -> float:
    """The shortest decimal number that a float32 setting stands for: 0.1, not 0.10000000149."""
    return float(str(np.float32(value)))


CLASSES = (DerenzoProperties, VolumeProperties)
