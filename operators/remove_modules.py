"""Modules removed with all that belongs to them."""

from __future__ import annotations

import bpy

from ..addon import copies, ids, scanner, selection
from ..addon.replacement import modules_text
from ..core.errors import InputError


class MPHDRR_OT_remove_modules(bpy.types.Operator):
    """``bpy.ops.mphdrr.remove_modules()``: the selected ones."""

    bl_idname = ids.REMOVE_MODULES
    bl_label = "Remove Modules"
    bl_description = "Delete the selected modules with their collimators and crystals"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_module(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        modules = selection.selected_modules(context)
        text = modules_text([o.mphdrr_module.number for o in modules])
        try:
            copies.remove(scanner.required_scanner(context.scene), modules)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Removed {text}")
        return {"FINISHED"}
