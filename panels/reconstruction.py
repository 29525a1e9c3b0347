"""Sidebar, Reconstruction: a volume from the shown run, with its objective and its scores."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, layouts, plots, reports
from ..addon.reconstruction.reconstruction_properties import panel_properties
from ..addon.runs import runs
from .sidebar import Folded, Popover, draw_text

_MAIN = ("method", "iterations", "voxels")
"""Settings that beginners need, which the panel itself shows; all others stand under Advanced."""
_DOTS = {"green": "NODE_SOCKET_SHADER", "amber": "NODE_SOCKET_OBJECT", "red": "NODE_SOCKET_MATERIAL"}
"""Blender's icons for the verdict on a sector's rods: dots of these colours."""
_PLOT_HEIGHT = 3.0  # in units of a button's height


class MPHDRR_PT_reconstruction(Folded, bpy.types.Panel):
    bl_order = ids.ORDER_RECONSTRUCTION

    poll = layouts.shown_where(lambda context: runs.shown_run(context.scene) is not None)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        settings = context.scene.mphdrr_reconstruction
        if (run := runs.shown_run(context.scene)) is not None:  # the scene may have changed since poll
            layout.label(text=iface("Of {run}").format(run=run.name), translate=False, icon="RENDER_STILL")
        main = layout.column(align=True)
        main_settings = (setting for setting in panel_properties(settings) if setting[0] in _MAIN)
        layouts.draw_settings(main, settings, main_settings)
        row = layouts.invoking(layout.row())
        row.scale_y = 1.4
        row.operator("mphdrr.reconstruct", text="Reconstruct", icon="OUTLINER_OB_VOLUME")
        row = layout.row(align=True)
        row.popover("MPHDRR_PT_backprojection")
        row.popover("MPHDRR_PT_reconstruction_model", icon="PREFERENCES")
        if (result := settings.details) and settings.volume is not None:
            _draw_result(layout, settings, result)


def _draw_result(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, result: dict) -> None:
    """Draw the objective's plot, and the scores of the volume against the truth."""
    box = layout.box()
    box.label(text=result["title"], translate=False, icon="OUTLINER_DATA_VOLUME")
    if result["objective"]:  # a method may have none
        split = box.split(factor=0.4)
        split.template_icon(icon_value=plots.objective_icon(result["objective"]), scale=_PLOT_HEIGHT)
        column = split.column(align=True)
        column.label(text=result["name"].capitalize())
        column.label(text=f"{result['objective'][-1]:.7g}", translate=False)
    scores = box.column(align=True)
    draw_text(scores, result.get("voxels", ""), "NONE")
    for name, value in result["scores"]:
        row = scores.split(factor=0.3)
        row.label(text=name, translate=False)
        draw_text(row, value, "NONE")
    rods = result.get("rods", ())
    scored = [row for row in rods if row[3]]
    for name, light, *values in [("Rods", "", "Valley/Peak", "Contrast"), *scored] if scored else ():
        row = scores.split(factor=0.3)
        row.label(text=name, translate=name == "Rods", icon=_DOTS.get(light, "BLANK1"))
        row = row.split(factor=0.55)
        for text in values:
            row.label(text=text, translate=name == "Rods")
    for reason in dict.fromkeys(row[2] for row in rods if not row[3]):
        sizes = ", ".join(row[0] for row in rods if row[2] == reason)
        draw_text(scores, f"{sizes}: {reason}", "BLANK1")
    for text in result.get("flatters", ()):
        draw_text(box, text)
    row = layouts.invoking(box.row())
    row.operator("mphdrr.continue_reconstruction", text="Continue (+10)", icon="FORWARD")
    row.operator("mphdrr.show_reconstruction", text="Show Slices", icon="IMAGE_DATA")


class MPHDRR_PT_reconstruction_model(Popover, bpy.types.Panel):
    """Set what is rarely changed: the voxels' size and place, subsets, the model, a prior, a file as method."""

    bl_label = "Advanced"

    def draw(self, context: bpy.types.Context) -> None:
        settings = context.scene.mphdrr_reconstruction
        rest = (setting for setting in panel_properties(settings) if setting[0] not in _MAIN)
        column = layouts.labelled(self.layout).column()
        if runs.holds_counts(context.scene):
            column.prop(settings, "mu", placeholder="The run's")
        layouts.draw_settings(column, settings, rest)
        if not reports.has("torch"):
            draw_text(column, "A method file needs torch, which is not in Blender", "INFO")


class MPHDRR_PT_backprojection(Popover, bpy.types.Panel):
    """Combine all modules' projections along their rays in each voxel of a volume, which is no reconstruction."""

    bl_label = "Back-Projection"

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        layout.prop(context.scene.mphdrr_reconstruction, "how")
        layout.operator("mphdrr.backproject", text="Back-Project", icon="OUTLINER_DATA_VOLUME")
