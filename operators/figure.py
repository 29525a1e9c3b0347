"""File > Export > mphDRR Figure: a picture as papers show it, of what is in the scene."""

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..addon.blender import file_properties, jobs, reports
from ..addon.figures import figures
from ..addon.scanner import scanner
from ..addon.volumes import volumes
from ..core.errors import InputError
from ..core.figures.page import LARGEST, SUFFIXES

_PIXELS = {"description": "Pixels; 0: what suits the figure", "min": 0, "max": LARGEST, "subtype": "PIXEL"}
_SHOWN: reports.Need = (
    lambda context: scanner.active_scanner(context.scene) or volumes.volume_objects(context.scene),
    "Nothing to show: import a workbook or add a phantom first",
)


class MPHDRR_OT_export_figure(jobs.ExportJob, bpy.types.Operator):
    """Draw a figure of the scanner, the volume or the last projections as PNG, or as SVG whose labels are text"""

    endings = SUFFIXES
    filepath: file_properties.file_property("File to write")
    filter_glob: file_properties.shown_files(SUFFIXES)
    figure: EnumProperty(name="Figure", description="What is shown", items=figures.KIND_ITEMS, default="SCANNER")
    width: IntProperty(name="Width", **_PIXELS)
    height: IntProperty(name="Height", **_PIXELS)
    modules: StringProperty(
        name="Modules", description="Such as 1-40 or 1-20,41; empty: all, or of figures of one module the active one"
    )
    labels: BoolProperty(name="Labels", description="Write title and axes on rendered figures", default=True)
    samples: IntProperty(
        name="Samples", description="Rays per pixel of rendered figures: the more, the smoother and slower",
        default=figures.SAMPLES, min=1, soft_max=256,
    )  # fmt: skip

    poll = reports.needs(_SHOWN)

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        if self.filepath:
            return None
        self.filepath = f"figure{SUFFIXES[0]}"
        return super().ask(context)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.given_file(f"set filepath to a name ending in {' or '.join(SUFFIXES)}")
        if bool(self.width) != bool(self.height):
            raise InputError("size: give both width and height, or neither")
        size = (self.width, self.height) if self.width else None
        name = self.figure.lower().replace("_", "-")
        return figures.figure_job(context, name, [path], size, self.modules or None, self.labels, self.samples)
