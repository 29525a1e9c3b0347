"""Which modules are seen, and seeing through one."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, IntProperty

from ..addon import ids, scanner, selection
from ..core.errors import InputError


class MPHDRR_OT_show_modules(bpy.types.Operator):
    """``bpy.ops.mphdrr.show_modules(first=1, last=40, mode="ONLY")``."""

    bl_idname = ids.SHOW_MODULES
    bl_label = "Show Modules"
    bl_description = "Show or hide modules with their collimators and crystals, in the viewport and in renders"
    bl_options = {"REGISTER", "UNDO"}

    first: IntProperty(name="First", description="First module number of the range", default=1)
    last: IntProperty(name="Last", description="Last module number of the range", default=1)
    mode: EnumProperty(
        name="Mode",
        items=[
            ("ONLY", "Show Only", "Show the modules of the range and hide all others", 0),
            ("SHOW", "Show", "Show the modules of the range; the others stay as they are", 1),
            ("HIDE", "Hide", "Hide the modules of the range; the others stay as they are", 2),
            ("ALL", "Show All", "Show all modules", 3),
        ],
        default="ONLY",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        range_text = f"modules {properties.first} to {properties.last}"
        return {
            "ONLY": f"Show {range_text} and hide all others, in the viewport and in renders",
            "SHOW": f"Show {range_text}",
            "HIDE": f"Hide {range_text}",
            "ALL": "Show all modules",
        }[properties.mode]

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            n_visible = scanner.show_modules(scanner.active_scanner(context.scene), self.first, self.last, self.mode)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{n_visible} modules visible")
        return {"FINISHED"}


class MPHDRR_OT_look_through_module(bpy.types.Operator):
    """``bpy.ops.mphdrr.look_through_module(number=7)``."""

    bl_idname = ids.LOOK_THROUGH_MODULE
    bl_label = "Look Through Module"
    bl_description = "Make the module's pinhole camera the scene's camera, and look through it"
    bl_options = {"REGISTER", "UNDO"}

    number: IntProperty(name="Number", description="Module number", default=1)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            context.scene.camera = scanner.module(scanner.active_scanner(context.scene), self.number)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        area = context.area
        if area is not None and area.type == "VIEW_3D":
            area.spaces.active.region_3d.view_perspective = "CAMERA"
        return {"FINISHED"}
