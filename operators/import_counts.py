"""File > Import > Measured Counts: read frames of a real or simulated scanner as a run of the scene's scanner."""

from typing import Any

import bpy
from bpy.props import FloatProperty, StringProperty

from ..addon.blender import decimals, jobs, layouts, storage
from ..addon.blender.file_properties import DIRECTORY, file_property, files_property, shown_files
from ..addon.blender.setting_properties import make_properties, read_values
from ..addon.runs import counts_import
from ..core.runs.frame_files import COUNTS_FORMATS
from ..core.runs.settings import SETTINGS

_PROPERTIES = {
    key.partition(".")[2]: setting
    for key, setting in SETTINGS.items()
    if key.startswith("counts.") and key not in ("counts.files", "counts.frames_file")
}
"""Settings of the files, by the names of the operator's properties."""


class MPHDRR_OT_import_counts(jobs.JobOperator, bpy.types.Operator):
    """Read measured counts, a frame for each module of the scanner, as projections. The order and orientation of the frames
    are never guessed: set them, and check the mosaic.
    """

    bl_label = "Import Measured Counts"
    asks_for = "filepath"

    filepath: file_property("File with the counts")
    directory: DIRECTORY
    files: files_property("Files with counts, if several: their frames follow each other in the order of the names")
    filter_glob: shown_files(COUNTS_FORMATS)
    time: FloatProperty(
        name="Time (s)", description="Exposure of the frames in seconds; 0: that of the files", default=0.0, min=0.0,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    pixel: FloatProperty(
        name="Pixel (mm)",
        description="Side in mm of a pixel on the crystal; 0: the crystal's side divided by the number of pixels",
        default=0.0, min=0.0,
    )  # fmt: skip
    modules: StringProperty(name="Modules", description="Modules that have frames, such as 1-40. Empty: all")

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        layouts.draw_all(layout, self, "frames", "orientation", "time")
        layouts.draw_all(layout.column(heading="If Needed"), self, "modules", "pixel", "expected", "dataset")
        layouts.draw_all(
            layout.column(heading="Scatter"),
            self,
            "lower_frames",
            "upper_frames",
            "window_widths",
            "scatter_fwhm",
            "scatter_tails",
        )
        layouts.draw_all(layout.column(heading="Raw File"), self, "raw_type", "raw_shape", "raw_big_endian")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        names = sorted({item.name for item in self.files if item.name})
        folder = storage.absolute(self.directory)
        paths = [folder / name for name in names] if len(names) > 1 else [storage.absolute(self.filepath)]
        return counts_import.import_counts_job(context, paths if self.filepath or names else [], self._entries())

    def _entries(self) -> dict[str, Any]:
        """Return the settings as entries of a recipe, by key; None for those that are not set."""
        settings = read_values(_PROPERTIES, lambda name: getattr(self, name))
        return {
            **{key: value or None for key, value in settings.items()},
            "model.time": decimals.typed(self.time) or None,
            "detector.pitch": decimals.typed(self.pixel) or None,
            "system.modules": self.modules or None,
        }


MPHDRR_OT_import_counts.__annotations__.update(make_properties(_PROPERTIES))
