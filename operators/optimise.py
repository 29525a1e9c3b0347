"""Design > Optimise: optimise a scanner by gradients, as a job."""

import bpy

from ..addon.blender import file_properties, jobs, reports
from ..addon.scanner import optimising


class MPHDRR_OT_optimise(jobs.JobOperator, bpy.types.Operator):
    """Optimise a scanner by a design recipe (.toml). It moves in the scene meanwhile: the active scanner if it has as many
    modules as the recipe's, else a new one. Cancel restores it, Finish Now keeps the best so far.
    """

    bl_label = "Optimise Scanner"

    poll = reports.needs(reports.package("scipy"))

    asks_for = "filepath"
    filepath: file_properties.file_property("Recipe of the design")
    filter_glob: file_properties.shown_files([".toml"])

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return optimising.optimize_job(context.scene, self.required_file("set filepath to a design recipe (.toml)"))
