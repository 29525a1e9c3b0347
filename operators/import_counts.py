"""File > Import > Measured Counts: frames of a real or another simulator's scanner become a run of the scene's scanner."""

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, IntVectorProperty, StringProperty

from ..addon.blender import choices, decimals, jobs, layouts, storage
from ..addon.blender.file_properties import DIRECTORY, file_property, files_property, shown_files
from ..addon.runs import counts_import
from ..core.runs.frame_files import COUNTS_FORMATS, RAW_TYPES
from ..core.runs.orientations import ORIENTATIONS

_NONE = "UNSAID"


def _items(words: Any, text: str) -> choices.Items:
    return choices.items({}, [(_NONE, "Not Said", text), *words])


class MPHDRR_OT_import_counts(jobs.JobOperator, bpy.types.Operator):
    """Read measured counts, a frame for each module of the scanner, as projections. Which frame is which module, and how
    frames lie on the crystals, is never guessed: say it, and check the mosaic
    """

    bl_label = "Import Measured Counts"
    asks_for = "filepath"

    filepath: file_property("With the counts")
    directory: DIRECTORY
    files: files_property("With counts, if several: their frames follow each other in the order of the names")
    filter_glob: shown_files(COUNTS_FORMATS)
    frames: StringProperty(
        name="Frames", description="Which module each frame is of: the modules' numbers in the frames' order, such as 1-80, "
        "80-1 or 3,1,2; none for a frame that is not used, none*80 for 80 of them",
    )  # fmt: skip
    orientation: EnumProperty(
        name="Orientation",
        description="How a frame, as a picture with row 0 at the top, lies on the crystal: seen from which side, with which "
        "of the module's axes at the top",
        items=_items([(word, *words) for word, words in ORIENTATIONS.items()], "Nothing is imported until it is said"),
        default=_NONE,
    )
    time: FloatProperty(
        name="Time (s)", description="Exposure of the frames in seconds; 0: that of the files", default=0.0, min=0.0,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    pixel: FloatProperty(
        name="Pixel (mm)",
        description="Side in mm of a pixel on the crystal; 0: the crystal's side divided by the number of pixels",
        default=0.0, min=0.0,
    )  # fmt: skip
    modules: StringProperty(name="Modules", description="That have frames, such as 1-40. Empty: all")
    expected: BoolProperty(name="Expected Means", description="The numbers are expected counts, which may be fractions")
    lower_frames: StringProperty(
        name="Lower Window", description="Frames of the energy window below the peak's, as in Frames: scatter is estimated "
        "from them, and expected in reconstructions. Empty: none",
    )  # fmt: skip
    upper_frames: StringProperty(
        name="Upper Window", description="Frames of the energy window above the peak's, likewise. Empty: none"
    )
    window_widths: FloatVectorProperty(
        name="Widths (keV)", description="Of the lower, the peak and the upper energy window; 0: what the file says",
        size=3, default=(0.0, 0.0, 0.0), min=0.0,
    )  # fmt: skip
    scatter_fwhm: FloatProperty(
        name="Smoothing (pixels)", description="FWHM of the Gaussian that smooths the estimate of scatter; 0: none",
        default=0.0, min=0.0,
    )  # fmt: skip
    scatter_tails: BoolProperty(
        name="Peak's Tails", description="What the peak's tails add to those windows is no scatter. Needs Isotope and "
        "Energy FWHM, under Physics",
    )  # fmt: skip
    dataset: StringProperty(name="Array", description="Its name in .npz and .h5. Empty: the only one of three axes")
    raw_type: EnumProperty(
        name="Type", description="Of the numbers in a raw file",
        items=_items([(name, name, "") for name in RAW_TYPES], "The file is not raw"), default=_NONE,
    )  # fmt: skip
    raw_shape: IntVectorProperty(
        name="Shape", description="Frames, rows and columns of a raw file", size=3, default=(0, 0, 0), min=0
    )
    raw_big_endian: BoolProperty(name="Big-Endian", description="The most significant byte of a number comes first")

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
        return counts_import.importing(context, paths if self.filepath or names else [], self._given())

    def _given(self) -> dict[str, Any]:
        """The entries of a recipe that are given; None for the others."""
        return {
            "counts.frames": self.frames or None,
            "counts.orientation": None if self.orientation == _NONE else [self.orientation],
            "counts.expected": self.expected or None,
            "counts.lower_frames": self.lower_frames or None,
            "counts.upper_frames": self.upper_frames or None,
            "counts.window_widths": tuple(map(decimals.typed, self.window_widths)) if any(self.window_widths) else None,
            "counts.scatter_fwhm": decimals.typed(self.scatter_fwhm) or None,
            "counts.scatter_tails": self.scatter_tails or None,
            "counts.dataset": self.dataset or None,
            "counts.raw_type": None if self.raw_type == _NONE else self.raw_type,
            "counts.raw_shape": tuple(self.raw_shape) if any(self.raw_shape) else None,
            "counts.raw_big_endian": self.raw_big_endian or None,
            "model.time": decimals.typed(self.time) or None,
            "detector.pitch": decimals.typed(self.pixel) or None,
            "system.modules": self.modules or None,
        }
