"""One module's numbers for others."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty

from ..addon import ids, scanner, selection


class MPHDRR_OT_set_numbers(bpy.types.Operator):
    """``bpy.ops.mphdrr.set_numbers(to_all=True)``."""

    bl_idname = ids.SET_NUMBERS
    bl_label = "Copy Numbers to Selected"
    bl_description = "Give the selected modules the active module's d, l, Ld, Td and R"
    bl_options = {"REGISTER", "UNDO"}

    to_all: BoolProperty(name="All", description="Give them to all modules of the scanner", options={"SKIP_SAVE"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_module(cls, context)

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return f"Give {'all' if properties.to_all else 'the selected'} modules the active module's d, l, Ld, Td and R"

    def execute(self, context: bpy.types.Context) -> set[str]:
        collection, active = scanner.required_scanner(context.scene), _active(context)
        others = scanner.modules(collection) if self.to_all else selection.selected_modules(context)
        scanner.copy_numbers(collection, active, [camera for camera in others if camera != active])
        self.report({"INFO"}, f"{len(set(others) | {active})} modules have the numbers of {active.name}")
        return {"FINISHED"}


def _active(context: bpy.types.Context) -> bpy.types.Object:
    return selection.active_module(context) or selection.selected_modules(context)[0]
