"""Sidebar, after the runs: from the shown run back to a volume, and what that is worth."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, layouts, plots
from ..addon.reconstruction.reconstruction_properties import panel_properties
from ..addon.runs import runs
from .sidebar import Folded, Popover, draw_text

_MAIN = ("method", "iterations", "voxels")
"""A beginner's settings, which the panel itself shows; the others stand under Advanced."""
_DOTS = {"green": "NODE_SOCKET_SHADER", "amber": "NODE_SOCKET_OBJECT", "red": "NODE_SOCKET_MATERIAL"}
"""Blender's icons that are dots in the colours of rods' lights."""
_PLOT = 3.0  # of a button's heights


class MPHDRR_PT_reconstruction(Folded, bpy.types.Panel):
    bl_order = ids.ORDER_RECONSTRUCTION

    poll = layouts.shown_where(lambda context: runs.shown_run(context.scene) is not None)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        settings = context.scene.mphdrr_reconstruction
        run = runs.shown_run(context.scene)
        if run is not None:  # the scene may have changed since poll
            layout.label(text=iface("Of {run}").format(run=run.name), translate=False, icon="RENDER_STILL")
        main = layout.column(align=True)
        layouts.draw_settings(main, settings, (each for each in panel_properties(settings) if each[0] in _MAIN))
        row = layouts.invoking(layout.row())
        row.scale_y = 1.4
        row.operator("mphdrr.reconstruct", text="Reconstruct", icon="OUTLINER_OB_VOLUME")
        row = layout.row(align=True)
        row.popover("MPHDRR_PT_backprojection")
        row.popover("MPHDRR_PT_reconstruction_model", icon="PREFERENCES")
        known = settings.details
        if known and settings.volume is not None:
            _draw_result(layout, settings, known)


def _draw_result(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, known: dict) -> None:
    """The objective's plot, and the scores beside the truth."""
    box = layout.box()
    box.label(text=known["title"], translate=False, icon="OUTLINER_DATA_VOLUME")
    if known["objective"]:  # a method may have none
        split = box.split(factor=0.4)
        split.template_icon(icon_value=plots.objective_icon(known["objective"]), scale=_PLOT)
        column = split.column(align=True)
        column.label(text=known["name"].capitalize())
        column.label(text=f"{known['objective'][-1]:.7g}", translate=False)
    scores = box.column(align=True)
    draw_text(scores, known.get("voxels", ""), "NONE")
    for name, value in known["scores"]:
        row = scores.split(factor=0.3)
        row.label(text=name, translate=False)
        draw_text(row, value, "NONE")
    rods = known.get("rods", ())
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
    for text in known.get("flatters", ()):
        draw_text(box, text)
    row = layouts.invoking(box.row())
    row.operator("mphdrr.continue_reconstruction", text="Continue (+10)", icon="FORWARD")
    row.operator("mphdrr.show_reconstruction", text="Show Slices", icon="IMAGE_DATA")


class MPHDRR_PT_reconstruction_model(Popover, bpy.types.Panel):
    """What few change: the voxels' size and place, subsets, the model, a prior, a file that is the method."""

    bl_label = "Advanced"

    def draw(self, context: bpy.types.Context) -> None:
        settings = context.scene.mphdrr_reconstruction
        others = (each for each in panel_properties(settings) if each[0] not in _MAIN)
        column = layouts.labelled(self.layout).column()
        if runs.holds_counts(context.scene):
            column.prop(settings, "mu", placeholder="The run's")
        layouts.draw_settings(column, settings, others)


class MPHDRR_PT_backprojection(Popover, bpy.types.Panel):
    """What all modules say of each voxel along their rays, as a volume: a sight, not a reconstruction."""

    bl_label = "Back-Projection"

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        layout.prop(context.scene.mphdrr_reconstruction, "how")
        layout.operator("mphdrr.backproject", text="Back-Project", icon="OUTLINER_DATA_VOLUME")
