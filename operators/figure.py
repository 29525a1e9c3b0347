"""File > Export > mphDRR Figure, Picture and Animation: draw or render the scene for papers and talks."""

from typing import Any, cast

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon.blender import file_properties, ids, jobs, layouts, reports
from ..addon.blender.choices import items
from ..addon.figures import figures
from ..addon.scanner import scanner
from ..addon.volumes import volumes
from ..core.errors import InputError
from ..core.figures.kinds import FILMS, PAPERS, SAMPLES, Rendering, figure_kind
from ..core.figures.page import LARGEST, SUFFIXES

_PIXELS = {"description": "Pixels; 0: Auto", "min": 0, "max": LARGEST, "subtype": "PIXEL"}
_STYLES = ((name, name.title(), f"On {name} paper") for name in PAPERS)
_SHOWN: reports.Need = (
    lambda context: scanner.active_scanner(context.scene) or volumes.volume_objects(context.scene),
    "Nothing to show: import a workbook or add a phantom first",
)


def _change_size(operator: Any, context: bpy.types.Context) -> None:
    """Begin with the size that suits the figure where Auto is taken away."""
    size = figure_kind(_kind_name(operator)).size
    operator.width, operator.height = (0, 0) if operator.automatic else size


def _kind_name(operator: Any) -> str:
    """Return the name of the chosen kind of figure."""
    return operator.figure.lower().replace("_", "-")


class FigureOperator(jobs.ExportJob):
    """Base class of the operators that export a figure."""

    endings: tuple[str, ...] = SUFFIXES
    filepath: file_properties.file_property("File to write")
    filter_glob: file_properties.shown_files((*SUFFIXES, *FILMS))
    automatic: BoolProperty(name="Auto", description="Size that suits the figure", default=True, update=_change_size)
    width: IntProperty(name="Width", **_PIXELS)
    height: IntProperty(name="Height", **_PIXELS)
    modules: StringProperty(
        name="Modules",
        description="Such as 1-40 or 1-20,41; empty: all, or in a picture those selected or a ring, or the active one",
    )
    labels: BoolProperty(name="Labels", description="Write titles, axes and scales on rendered figures", default=True)
    style: EnumProperty(name="Style", description="Style of rendered figures", items=items({}, _STYLES), default="dark")
    samples: IntProperty(name="Samples",
                         description="Rays per pixel of rendered figures: the more, the smoother and slower",
                         default=SAMPLES, min=1, soft_max=256)  # fmt: skip

    poll = reports.needs(_SHOWN)

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        if self.filepath:
            return None
        self.filepath = ids.label(type(self).__name__).split()[-1].lower() + self.endings[0]
        return super().ask(context)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the settings, the size only where it is not automatic."""
        layout, operator = layouts.labelled(self.layout), cast(Any, self)
        layout.row(heading="Size").prop(operator, "automatic")
        names = ["figure", *(("width", "height") if operator.width else ()), "modules", *Rendering._fields]
        layouts.draw_all(layout, operator, *(name for name in names if name in operator.properties.bl_rna.properties))

    def job(self, context: bpy.types.Context) -> jobs.Job:
        operator: Any = self  # the type checker does not know Blender's properties
        path = self.required_file(f"set filepath to a name ending in {' or '.join(self.endings)}")
        if bool(operator.width) != bool(operator.height):
            raise InputError("size: give both width and height, or neither")
        size = (operator.width, operator.height) if operator.width else None
        style = {name: value for name, value in self.as_keywords().items() if name in Rendering._fields}
        return figures.figure_job(context, _kind_name(operator), [path], size, operator.modules or None, **style)


class MPHDRR_OT_export_figure(FigureOperator, bpy.types.Operator):
    """Draw a figure of the scanner, the volume or the last projections as PNG, or as SVG whose labels are text."""

    figure: EnumProperty(name="Figure", description="Kind of the figure", items=figures.kind_items(), default="SCANNER")


class MPHDRR_OT_render_picture(FigureOperator, bpy.types.Operator):
    """Render the volume in the scanner for a paper, with scale, colour bar and rays of the selected modules or a ring."""

    figure = "PICTURE"


class MPHDRR_OT_render_animation(FigureOperator, bpy.types.Operator):
    """Render pictures and an MP4 of the volume in the scanner: once around it, or one module lit after the other."""

    endings = FILMS
    figure: EnumProperty(
        name="Animation", description="Kind of the animation", items=figures.kind_items(True), default="TURNTABLE"
    )
    seconds: FloatProperty(
        name="Seconds", description="Duration of the animation", default=Rendering().seconds, min=0.01, soft_max=60.0
    )
    fps: IntProperty(name="Frames per Second", default=Rendering().fps, description="Pictures", min=1, max=60)
