"""Slice planes through the active volume."""

from __future__ import annotations

import bpy

from ..addon import ids, slices, volumes
from ..core.errors import InputError


class MPHDRR_OT_add_slices(bpy.types.Operator):
    bl_idname = ids.ADD_SLICES
    bl_label = "Add Slices"
    bl_description = "Show an axial, a coronal and a sagittal slice of the active volume as planes that go with it"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.poll_volume(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            slices.add_slices(context.object)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for area in context.screen.areas if context.screen else ():
            space = area.spaces.active
            if space.type == "VIEW_3D":
                space.shading.color_type = "TEXTURE"  # the solid viewport's default shows no pictures
        return {"FINISHED"}


class MPHDRR_OT_remove_slices(bpy.types.Operator):
    bl_idname = ids.REMOVE_SLICES
    bl_label = "Remove Slices"
    bl_description = "Remove the active volume's slice planes"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not volumes.poll_volume(cls, context):
            return False
        if not slices.planes_of(context.object):
            cls.poll_message_set("The active volume has no slices")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        slices.remove_slices(context.object)
        return {"FINISHED"}
