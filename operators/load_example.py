"""The example in one click."""

import bpy

from ..addon import example, ids, jobs
from ..addon.reports import polled


class MPHDRR_OT_load_example(jobs.JobOperator, bpy.types.Operator):
    """Load the bundled scanner of 80 modules with a Derenzo phantom, and show what every module sees of it"""

    bl_idname = ids.LOAD_EXAMPLE
    bl_label = "Load Example"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return polled(cls, not jobs.is_running(), "Another job is running: wait for it or cancel it")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return example.example_job(context)
