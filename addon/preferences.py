"""Preferences of the extension: defaults that a user sets once."""

from __future__ import annotations

import bpy
from bpy.props import FloatProperty

PACKAGE = __package__.rpartition(".")[0]  # "mphdrr", or "bl_ext.<repo>.mphdrr" when installed as an extension


class MPHDRR_Preferences(bpy.types.AddonPreferences):
    """Defaults of the import dialog."""

    bl_idname = PACKAGE

    plate_thickness: FloatProperty(
        name="Aperture Plate", description="Default thickness in mm of the plate that holds the pinhole",
        default=2.0, min=0.01, soft_max=20.0,
    )  # fmt: skip
    wall_thickness: FloatProperty(
        name="Collimator Wall", description="Default thickness in mm of the collimator's walls",
        default=2.0, min=0.01, soft_max=20.0,
    )  # fmt: skip

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        column = layout.column(align=True)
        column.prop(self, "plate_thickness", text="Aperture Plate (mm)")
        column.prop(self, "wall_thickness", text="Collimator Wall (mm)")


def preferences(context: bpy.types.Context) -> MPHDRR_Preferences | None:
    """The user's preferences, or None where the package runs without being an enabled add-on (bpy wheel)."""
    addon = context.preferences.addons.get(PACKAGE)
    return addon.preferences if addon else None
