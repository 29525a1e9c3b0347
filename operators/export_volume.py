"""File > Export > Volume: the active volume, where it stands in the world, for other programs."""

import bpy
from bpy.props import StringProperty

from ..addon.blender import jobs
from ..addon.blender.reports import needs
from ..addon.phantoms.volume_export import WRITTEN_ENDINGS, exporting
from ..addon.volumes import volumes


class MPHDRR_OT_export_volume(jobs.JobOperator, bpy.types.Operator):
    bl_label = "Export Volume"
    bl_description = (
        f"Write every voxel of the active volume, where it stands in the world; endings: {', '.join(WRITTEN_ENDINGS)}"
    )
    bl_options = set()

    filepath: StringProperty(name="File", description="File to write", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{e}" for e in WRITTEN_ENDINGS), options={"HIDDEN"})

    poll = needs(volumes.ACTIVE)

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        if self.filepath:
            return None
        self.filepath = bpy.path.clean_name(context.object.name) + WRITTEN_ENDINGS[0]
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.given_file(f"expected a name ending in {', '.join(WRITTEN_ENDINGS)}")
        return exporting(context.object, path)
