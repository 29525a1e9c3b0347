"""What Blender's own copying and deleting leaves, put in order."""

from __future__ import annotations

import bpy

from ..addon import copies, ids, scanner, selection
from ..addon.replacement import modules_text
from ..core.errors import InputError


class MPHDRR_OT_tidy_modules(bpy.types.Operator):
    """``bpy.ops.mphdrr.tidy_modules()``: in all scanners of the scene."""

    bl_idname = ids.TIDY_MODULES
    bl_label = "Tidy Modules"
    bl_description = (
        "Make copied cameras modules, with numbers, collimators and crystals of their own, and remove collimators and "
        "crystals whose camera was deleted"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        numbers: list[int] = []
        n_parts = 0
        try:
            for collection in scanner.scanners(context.scene):
                new, n = copies.tidy(collection)
                numbers, n_parts = numbers + new, n_parts + n
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        done = [f"made {modules_text(numbers)}"] if numbers else []
        if n_parts:
            done.append(f"removed {n_parts} parts without a camera")
        self.report({"INFO"}, " and ".join(done).capitalize() or "All modules are in order")
        return {"FINISHED"}
