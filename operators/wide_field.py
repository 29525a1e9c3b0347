"""The wide field of view: twice the crystal's, in pixels of the same size."""

import bpy

from ..addon import ids
from ..addon.reports import polled, run_reported
from ..core.errors import InputError


class MPHDRR_OT_wide_field(bpy.types.Operator):
    """Project twice the width and height of the crystal's field of view, in pixels of the same size; again: the crystal's.
    Display's Central Half then shows the crystal's field of view alone
    """

    bl_idname = ids.WIDE_FIELD
    bl_label = "Wide Field of View"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        settings = context.scene.mphdrr_projections
        counts, typed = settings.model == "EMISSION", settings.pitch > 0
        return polled(cls, not counts, "SPECT counts end at the crystal's side: choose another model") and polled(
            cls, not typed, "The pixels' size is typed: give more pixels, or set Pixel Size to 0"
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.mphdrr_projections

        def change() -> str:
            widen = settings.field <= 1
            columns, rows = (2 * n if widen else -(-n // 2) for n in (settings.width, settings.height))
            most = settings.bl_rna.properties["width"].hard_max
            if max(columns, rows) > most:
                raise InputError(f"{columns} x {rows} pixels: at most {most} along a side")
            settings.width, settings.height, settings.field = columns, rows, 2.0 if widen else 1.0
            return f"{columns} × {rows} pixels, {'twice the' if widen else 'the'} crystal's field of view"

        return run_reported(self, change)
