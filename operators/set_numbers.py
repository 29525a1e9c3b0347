"""One module's numbers for others."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty

from ..addon import ids, scanner


class MPHDRR_OT_set_numbers(bpy.types.Operator):
    """``bpy.ops.mphdrr.set_numbers(to_all=True)``."""

    bl_idname = ids.SET_NUMBERS
    bl_label = "Copy Numbers to Selected"
    bl_description = "Give the selected modules the active module's d, l, Ld, Td and R"
    bl_options = {"REGISTER", "UNDO"}

    to_all: BoolProperty(name="All", description="Give them to all modules of the scanner", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if scanner.poll_scanner(cls, context) and scanner.active_module(context) is None:
            cls.poll_message_set("No active module: select a module's camera")
            return False
        return scanner.active_scanner(context.scene) is not None

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return f"Give {'all' if properties.to_all else 'the selected'} modules the active module's d, l, Ld, Td and R"

    def execute(self, context: bpy.types.Context) -> set[str]:
        collection, active = scanner.active_scanner(context.scene), scanner.active_module(context)
        others = scanner.modules(collection) if self.to_all else scanner.selected_modules(context)
        scanner.copy_numbers(collection, active, [camera for camera in others if camera != active])
        self.report({"INFO"}, f"{len(set(others) | {active})} modules have the numbers of {active.name}")
        return {"FINISHED"}
