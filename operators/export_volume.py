"""File > Export > Volume: write the active volume, at its place in the world, for other programs."""

import bpy
from bpy.props import StringProperty

from ..addon.blender import file_properties, jobs, reports
from ..addon.phantoms.volume_export import WRITTEN_ENDINGS, export_job
from ..addon.volumes import volumes


class MPHDRR_OT_export_volume(jobs.ExportJob, bpy.types.Operator):
    bl_description = (
        f"Write every voxel of the active volume, where it stands in the world; endings: {', '.join(WRITTEN_ENDINGS)}"
    )
    endings = WRITTEN_ENDINGS
    filepath: file_properties.file_property("File to write")
    filter_glob: file_properties.shown_files(WRITTEN_ENDINGS)

    template: StringProperty(
        name="Template",
        description="DICOM file of which a .dcm takes the tags of patient, study and series",
        subtype="FILE_PATH",
    )
    tags: StringProperty(
        name="Tags", description="Tags of patient, study, series for .dcm: PatientName=Doe^Jo; StudyID=7"
    )

    poll = reports.needs(volumes.ACTIVE)

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        if self.filepath:
            return None
        self.filepath = bpy.path.clean_name(context.object.name) + WRITTEN_ENDINGS[0]
        return super().ask(context)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.required_file(f"expected a name ending in {', '.join(WRITTEN_ENDINGS)}")
        template = bpy.path.abspath(self.template)
        return export_job(context.object, path, template, self.tags)
