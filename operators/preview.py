"""Switch the live preview on and off."""

import bpy

from ..addon import ids, jobs, preview, scanner, volumes
from ..addon.reports import polled


class MPHDRR_OT_live_preview(bpy.types.Operator):
    """Show in the 3D views what the active module sees, made again while it, the phantom or a number changes; again: stop"""

    bl_idname = ids.LIVE_PREVIEW
    bl_label = "Live Preview"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        scene = context.scene
        return preview.session() is not None or (
            polled(cls, not bpy.app.background, "Needs a window")
            and polled(
                cls, scanner.active_scanner(scene) is not None, "No scanner in the scene: import a geometry first"
            )
            and polled(cls, bool(volumes.volume_objects(scene)), "No volume in the scene: add a phantom first")
            and polled(cls, not jobs.is_running(), "A job is running: wait for it or cancel it")
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        if preview.session() is None:
            preview.start()
        else:
            preview.stop()
        return {"FINISHED"}
