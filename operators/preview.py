"""Operator that switches the live preview on and off."""

import bpy

from ..addon.blender import jobs, reports
from ..addon.runs import preview
from ..addon.scanner import selection
from ..addon.volumes import volumes


class MPHDRR_OT_live_preview(bpy.types.Operator):
    """Show in the 3D views what the active module sees, updated when it, the phantom or a number changes; again: stop."""

    _can_start = reports.needs(
        (lambda context: not bpy.app.background, "Needs a window"),
        selection.SCANNER,
        (lambda context: volumes.volume_objects(context.scene), "No volume in the scene: add a phantom first"),
        (lambda context: not jobs.is_running(), "A job is running: wait for it or cancel it"),
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return preview.session() is not None or cls._can_start(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        if preview.session() is None:
            preview.start()
        else:
            preview.stop()
        return {"FINISHED"}
