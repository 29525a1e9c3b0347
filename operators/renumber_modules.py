"""Modules numbered anew."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty

from ..addon import ids, renumbering, scanner, selection
from ..core.errors import InputError


class MPHDRR_OT_renumber_modules(bpy.types.Operator):
    """``bpy.ops.mphdrr.renumber_modules(order="RINGS")``."""

    bl_idname = ids.RENUMBER_MODULES
    bl_label = "Renumber Modules"
    bl_description = (
        "Number all modules 1, 2, ... in an order, in which they are listed, projected and exported from now on"
    )
    bl_options = {"REGISTER", "UNDO"}

    order: EnumProperty(
        name="Order",
        description="What the numbers follow",
        items=(
            (
                "RINGS",
                "By Ring and Azimuth",
                "Ring by ring along +z, and along each ring from its gap on, the way most run",
                0,
            ),
            ("LIST", "As Listed", "In the present order, as in the workbook, those added last", 1),
        ),
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        collection = scanner.required_scanner(context.scene)
        try:
            changed = renumbering.renumber(collection, self.order)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        total = len(scanner.modules(collection))
        self.report({"INFO"}, f"Numbered {total} modules: {changed} have another number than before")
        return {"FINISHED"}
