"""Operators on the active volume in the coordinates of the active module: a frustum of pictures, or a resampled volume."""

import bpy

from ..addon.blender import jobs, reports
from ..addon.perspective import frustums, perspective_properties
from ..addon.scanner import selection
from ..addon.volumes import volumes


class _PerspectiveOperator(perspective_properties.PerspectiveSettings, jobs.JobOperator):
    """Base class of the operators that take the active volume into the coordinates of the active module."""

    poll = reports.needs((selection.active_module, "No module is active: import a geometry first"), volumes.ACTIVE)


class MPHDRR_OT_show_in_perspective(_PerspectiveOperator, bpy.types.Operator):
    """Show the active volume in the active module's own coordinates, column, row and magnification k: a frustum of pictures,
    each the volume's mean along the pixels' rays in its layer. Seen from the pinhole they cover each other. The frustum
    moves with the module; the settings are the panel's, unless a script gives others.
    """

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return frustums.frustum_job(
            context, *self.setting_values(context.scene.mphdrr_perspective, "planes", "uniform")
        )


class MPHDRR_OT_resample_in_perspective(_PerspectiveOperator, bpy.types.Operator):
    """Resample the active volume to the active module's cells, one for each pixel and layer of depth, and back to its own
    voxels, as a new volume, which shows the detail that these cells keep. Outside the module's field of view it is empty.
    """

    bl_label = "Volume Through Module"

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return frustums.resample_job(
            context, *self.setting_values(context.scene.mphdrr_perspective, "cells", "uniform")
        )


class MPHDRR_OT_clear_perspective(reports.Reported, bpy.types.Operator):
    """Remove all volumes in perspective, of all modules."""

    poll = reports.needs((lambda context: frustums.frustums(context.scene), "No volume is shown in perspective"))

    def act(self, context: bpy.types.Context) -> str:
        count = frustums.remove(context.scene)
        return f"Removed {count} volume{'s' * (count > 1)} in perspective"
