"""The active volume as the active module sees it: a frustum of pictures, or back on its own voxels."""

from typing import Any

import bpy

from ..addon import frustums, ids, jobs, selection, volumes
from ..addon.perspective_properties import PerspectiveSettings
from ..addon.reports import polled


class _InPerspective(PerspectiveSettings, jobs.JobOperator):
    """Mix into an operator that takes the active volume into the coordinates of the active module."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        """There are both."""
        if not polled(
            cls, selection.active_module(context) is not None, "No module is active: import a geometry first"
        ):
            return False
        return volumes.poll_volume(cls, context)

    def setting(self, context: bpy.types.Context, name: str) -> Any:
        """A setting given to the operator, else the panel's."""
        is_given = self.properties.is_property_set(name)  # type: ignore[attr-defined]
        return getattr(self if is_given else context.scene.mphdrr_perspective, name)


class MPHDRR_OT_show_in_perspective(_InPerspective, bpy.types.Operator):
    """Show the active volume in the active module's own coordinates, column, row and magnification k: a frustum of pictures,
    each the volume's mean along the pixels' rays in its layer. Seen from the pinhole they lie on one another. It goes with
    the module; the settings are what the panel says now, unless a script gives others
    """

    bl_idname = ids.SHOW_IN_PERSPECTIVE
    bl_label = "Show in Perspective"

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return frustums.showing(context, self.setting(context, "planes"), self.setting(context, "uniform"))


class MPHDRR_OT_resample_in_perspective(_InPerspective, bpy.types.Operator):
    """Take the active volume through the active module's cells, one for each pixel and layer of depth, and back to its own
    voxels, as a new volume: what these cells keep of it. Beyond what the module sees, it is empty
    """

    bl_idname = ids.RESAMPLE_IN_PERSPECTIVE
    bl_label = "Volume Through Module"

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return frustums.resampling(context, self.setting(context, "cells"), self.setting(context, "uniform"))


class MPHDRR_OT_clear_perspective(bpy.types.Operator):
    """Remove all volumes in perspective, of all modules"""

    bl_idname = ids.CLEAR_PERSPECTIVE
    bl_label = "Clear Perspective"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return polled(cls, bool(frustums.frustums(context.scene)), "No volume is shown in perspective")

    def execute(self, context: bpy.types.Context) -> set[str]:
        count = frustums.remove(context.scene)
        self.report({"INFO"}, f"Removed {count} volume{'s' * (count > 1)} in perspective")
        return {"FINISHED"}
