"""Slice planes through the active volume."""

from __future__ import annotations

import bpy

from ..addon import ids, slices, volumes
from ..addon.reports import run_reported


class MPHDRR_OT_add_slices(bpy.types.Operator):
    bl_idname = ids.ADD_SLICES
    bl_label = "Add Slices"
    bl_description = "Show an axial, a coronal and a sagittal slice of the active volume as planes that go with it"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.poll_volume(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        for area in context.screen.areas if context.screen else ():
            if area.type == "VIEW_3D":
                area.spaces.active.shading.color_type = "TEXTURE"  # the solid viewport's default shows no pictures
        return run_reported(self, lambda: f"Added {len(slices.add_slices(context.object))} slices")


class MPHDRR_OT_remove_slices(bpy.types.Operator):
    bl_idname = ids.REMOVE_SLICES
    bl_label = "Remove Slices"
    bl_description = "Remove the active volume's slice planes"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.poll_volume(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        slices.remove_slices(context.object)
        return {"FINISHED"}
