"""Geometry > Calibrate: fit the modules' positions to images of point sources, as a job."""

import bpy
from bpy.props import BoolProperty, FloatProperty

from ..addon.blender import file_properties, jobs, reports
from ..addon.runs import calibrating
from ..addon.scanner import selection


class MPHDRR_OT_calibrate(jobs.JobOperator, bpy.types.Operator):
    """Fit the positions of the scanner's modules to images of point sources by a calibration recipe (.toml); arrows lead
    from nominal to fitted pinholes.
    """

    poll = reports.needs(selection.SCANNER, reports.package("scipy"))

    asks_for = "filepath"
    filepath: file_properties.file_property("Recipe of the calibration")
    filter_glob: file_properties.shown_files([".toml"])
    apply: BoolProperty(name="Apply", description="Move the modules, not only show the shifts", default=True,
                        options={"SKIP_SAVE"})  # fmt: skip
    exaggeration: FloatProperty(
        name="Exaggeration", min=0.0, soft_max=1000.0,
        description="Length of the arrows in units of the shifts; 0: the longest arrow is about 50 mm",
    )  # fmt: skip

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.required_file("set filepath to a calibration recipe (.toml)")
        return calibrating.calibrate_job(context, path, self.apply, self.exaggeration)
