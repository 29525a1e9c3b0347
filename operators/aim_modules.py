"""Modules that were moved, aimed at the isocentre again."""

from __future__ import annotations

import bpy

from ..addon import ids, scanner, selection


class MPHDRR_OT_aim_modules(bpy.types.Operator):
    """``bpy.ops.mphdrr.aim_modules()``."""

    bl_idname = ids.AIM_MODULES
    bl_label = "Aim at Isocentre"
    bl_description = "Turn every module that was moved or turned so that it looks at the isocentre, where it stands"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        collection = scanner.active_scanner(context.scene)
        aimed = scanner.aim_modules(collection)
        scanner.refresh_scanner(collection)
        self.report(
            {"INFO"},
            f"Turned {len(aimed)} module{'s' * (len(aimed) > 1)}" if aimed else "All modules aim at the isocentre",
        )
        return {"FINISHED"}
