"""Design > Optimise: a scanner found by gradients, as a job."""

import bpy

from ..addon.blender import file_properties, jobs
from ..addon.scanner import optimising


class MPHDRR_OT_optimise(jobs.JobOperator, bpy.types.Operator):
    """Find the scanner that a design recipe (.toml) wants. It moves in the scene meanwhile: the active one, if the recipe's
    has as many modules, else a new one. Cancel takes it back, Finish Now keeps the best so far
    """

    bl_label = "Optimise Scanner"

    asks_for = "filepath"
    filepath: file_properties.file_property("Recipe of the design")
    filter_glob: file_properties.shown_files([".toml"])

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return optimising.optimize_job(context.scene, self.required_file("set filepath to a design recipe (.toml)"))
