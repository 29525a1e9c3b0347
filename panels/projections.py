"""Sidebar, third and last step: the projections, and the dataset that they give."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, jobs, layouts
from ..addon.runs import preview, rendering, runs
from ..addon.runs.projection_properties import drawn, makes_counts
from ..addon.scanner import scanner
from ..addon.volumes import volumes
from .runs import draw_changes
from .sidebar import Folded, Sidebar, draw_hint, draw_text

_MAIN = ("time", "photons", "hole", "aperture_points", "pixel_points")
"""Settings of models that the panel itself shows; the others stand under Physics."""


class MPHDRR_PT_projections(Sidebar, bpy.types.Panel):
    bl_order = ids.ORDER_PROJECTIONS

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        settings = context.scene.mphdrr_projections
        jobs.draw_job(layout)  # at the top, where it is seen on small screens too
        column = layout.column()
        column.prop(settings, "volume", placeholder="Active volume")
        column.prop(settings, "model")
        layouts.draw_settings(column, settings, (each for each in drawn(settings, "model") if each[0] in _MAIN))
        collection = scanner.active_scanner(context.scene)
        own = collection and scanner.own_pixels(collection)
        if own:  # as its views are, whatever the settings for other scanners
            split = column.split(factor=0.4)
            name = split.row()
            name.alignment = "RIGHT"  # as the settings' names
            name.label(text="Pixels")
            split.label(text=iface("{columns} × {rows}, its own").format(rows=own[0], columns=own[1]), translate=False)
        else:
            layouts.draw_settings(column, settings, drawn(settings, "detector"))
        modules = column.column(align=True)
        modules.prop(settings, "all_modules")
        if not settings.all_modules:
            layouts.draw_all(modules, settings, "first", "last")
        layouts.draw_settings(column, settings, drawn(settings, "compute"))
        row = layouts.invoking(layout.row())
        row.scale_y = 1.4
        has_scanner = collection is not None
        has_volume = bool(volumes.volume_objects(context.scene))
        row.enabled = has_scanner and has_volume
        row.operator("mphdrr.render_projections", icon="RENDER_STILL")
        layout.operator("mphdrr.load_recipe", icon="FILE_FOLDER")
        if not has_scanner:
            draw_hint(layout, "Needs a scanner: Load Example.")
        elif not has_volume:
            draw_hint(layout, "Needs a volume: Add Phantom.")
        elif rendering.integrates_activity(context):
            draw_text(layout, "Line integrals of activity: for counts choose the model SPECT Counts.", icon="INFO")
        if settings.run_file:
            layout.operator("mphdrr.show_projections", text="Show Mosaic", icon="IMAGE_DATA")
            draw_changes(layout, context.scene)


class MPHDRR_PT_preview(Sidebar, bpy.types.Panel):
    bl_label = "Live Preview"
    bl_parent_id = "MPHDRR_PT_projections"

    def draw(self, context: bpy.types.Context) -> None:
        layout, session = self.layout, preview.session()
        layout.operator("mphdrr.live_preview", icon="HIDE_OFF", depress=session is not None)
        if session is None:
            return
        column = layout.column(align=True)
        column.active = False
        draw_text(column, session.problem)
        column.label(text=iface("{size} of voxels kept in memory").format(size=session.kept))


class MPHDRR_PT_physics(Folded, bpy.types.Panel):
    bl_parent_id = "MPHDRR_PT_projections"

    poll = layouts.shown_where(lambda context: context.scene.mphdrr_projections.model != "INVERSE_SQUARE")

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        self.layout.operator_menu_enum("mphdrr.use_preset", "preset", text="", icon="PRESET")

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        settings = context.scene.mphdrr_projections
        column = layout.column(align=True)
        if settings.model == "EMISSION":
            column.prop(settings, "mu", placeholder="None")
            collection = scanner.active_scanner(context.scene)
            if collection is not None:
                column.prop(collection.mphdrr_scanner, "opening_angle")
        others = (each for each in drawn(settings, "model") if each[0] not in (*_MAIN, "model"))
        layouts.draw_settings(column, settings, others)
        row = layout.row(heading="Poisson Noise")
        row.active = makes_counts(settings)
        row.prop(settings, "noise", text="")
        seed = row.row()
        seed.active = settings.noise
        seed.prop(settings, "seed")


class MPHDRR_PT_export(Sidebar, bpy.types.Panel):
    bl_order = ids.ORDER_EXPORT

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(self.layout)
        run_file = context.scene.mphdrr_projections.run_file
        row = layout.row()
        row.enabled = bool(run_file)
        row.operator("mphdrr.export_dataset", text="Export Dataset", icon="EXPORT")
        layout.operator("mphdrr.export_figure", text="Export Figure", icon="IMAGE_DATA")
        if run_file:
            kept = run_file if run_file.startswith("//") else iface("kept when the .blend is saved")
            layout.label(text=iface("Shown run: {file}").format(file=kept), icon="FILE")
        else:
            draw_hint(layout, "Render projections first.")
        for line in runs.change_lines(context.scene):
            draw_text(layout, line)
