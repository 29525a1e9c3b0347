"""File > Export > mphDRR Dataset: the last run as one file."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty
from bpy_extras.io_utils import ExportHelper

from ..addon import ids, rendering
from ..addon.reports import run_reported


class MPHDRR_OT_export_dataset(ExportHelper, bpy.types.Operator):
    """Write the last run, with geometry, volume and provenance, as HDF5 (.h5), NumPy (.npz) or PyTorch (.pt)"""

    bl_idname = ids.EXPORT_DATASET
    bl_label = "Export mphDRR Dataset"

    filename_ext = ".h5"
    filter_glob: StringProperty(default="*.h5;*.hdf5;*.npz;*.pt", options={"HIDDEN"})

    def check(self, context: bpy.types.Context) -> bool:
        """Give a name without suffix the default one; the other formats' suffixes stay."""
        if Path(self.filepath).suffix:
            return False
        self.filepath += self.filename_ext
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        return run_reported(self, lambda: f"Wrote {rendering.export_run(context.scene, self.filepath)}")
