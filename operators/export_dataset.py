"""File > Export > mphDRR Dataset: the last run as one file."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty
from bpy_extras.io_utils import ExportHelper

from ..addon import ids, storage
from ..core.errors import InputError


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
        try:
            path = export_dataset(context.scene, self.filepath)
        except (InputError, MemoryError) as error:
            self.report({"ERROR"}, str(error) or "not enough memory to write the run")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {path}")
        return {"FINISHED"}

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        column.label(text="The name's ending chooses:")
        for line in (".h5    HDF5", ".npz  NumPy archive", ".pt    PyTorch"):
            column.label(text=line, icon="DOT")


def export_dataset(scene: bpy.types.Scene, filepath: str) -> Path:
    """Write a scene's last run to `filepath`, in the format of its suffix.

    Raises
    ------
    InputError
        There is no run, its file is gone, or the new one cannot be written.
    """
    from ..core.runs.files import read_run, write_run

    run_file = getattr(scene, ids.SCENE_PROJECTIONS).run_file
    if not run_file:
        raise InputError("nothing to export: render the projections first")
    source = storage.absolute(run_file)
    if not source.is_file():
        raise InputError(f"{source}: the last run's file is gone; render the projections again")
    if not filepath:
        raise InputError("no file given: set filepath to a name ending in .h5, .npz or .pt")
    path = storage.absolute(filepath)
    write_run(read_run(source), path)
    return path
