"""Modules copied along their ring."""

from __future__ import annotations

import math

import bpy
from bpy.props import BoolProperty, FloatProperty, IntProperty

from ..addon import copies, ids, scanner, selection
from ..addon.replacement import modules_text
from ..core.errors import InputError


class MPHDRR_OT_duplicate_modules(bpy.types.Operator):
    """``bpy.ops.mphdrr.duplicate_modules(count=3, angle=math.radians(9))``: of the selected modules."""

    bl_idname = ids.DUPLICATE_MODULES
    bl_label = "Duplicate Along Ring"
    bl_description = "Copy the selected modules, with collimators and crystals, to further places of their rings"
    bl_options = {"REGISTER", "UNDO"}

    count: IntProperty(name="Copies", description="Number of copies of each module", default=1, min=1, soft_max=40)
    angle: FloatProperty(
        name="Angle", description="From one copy to the next, about the z axis", subtype="ANGLE",
        default=math.radians(9.0), min=-math.pi, max=math.pi,
    )  # fmt: skip
    follow_ring: BoolProperty(
        name="Follow Ring",
        description="Take the distance from the z axis, and z, from the ring's other modules at the new azimuth, so that "
        "copies stay on an ellipse-like arc. Otherwise the module is turned about z",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_module(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        collection = scanner.required_scanner(context.scene)
        try:
            made = copies.duplicate(
                collection, selection.selected_modules(context), self.count, self.angle, self.follow_ring
            )
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        selection.select(context, made)
        self.report({"INFO"}, f"Made {modules_text([o.mphdrr_module.number for o in made])}")
        return {"FINISHED"}
