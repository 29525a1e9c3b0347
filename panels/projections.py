"""Sidebar, Projections and Export: settings of the Render job, and the files and pictures of a run."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, layouts
from ..addon.runs import preview, rendering, runs
from ..addon.runs.projection_properties import makes_counts, panel_properties
from ..addon.scanner import scanner
from ..addon.volumes import volumes
from .sidebar import Folded, Popover, draw_text

_MAIN = ("model", "time", "hole", "height", "width")
"""Settings that beginners need, which the panel itself shows."""
_PHYSICS = (
    "photons", "isotope", "panel", "window", "energy_fwhm", "sensor", "sensor_thickness", "materials",
    "aperture_material", "aperture_mu", "crystal_material", "crystal_mu",
    "intrinsic_fwhm", "background",
)  # fmt: skip
"""Settings under Physics; all others stand under Advanced."""


class MPHDRR_PT_projections(Folded, bpy.types.Panel):
    bl_order = ids.ORDER_PROJECTIONS

    poll = layouts.shown_where(lambda context: _can_render(context) or context.scene.mphdrr_projections.runs)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        settings = context.scene.mphdrr_projections
        column = layout.column(align=True)
        column.prop(settings, "volume", placeholder="Active volume")
        main = (setting for setting in panel_properties(settings, "model") if setting[0] in _MAIN)
        layouts.draw_settings(column, settings, main)
        collection = scanner.active_scanner(context.scene)
        pixels = collection and scanner.fixed_pixels(collection)
        split = column.split(factor=0.4)
        name = split.row()
        name.alignment = "RIGHT"  # like the settings' names
        name.label(text="Pixels")
        if pixels:  # the scanner's views have these pixels, whatever the settings are
            text = iface("{columns} × {rows}, its own").format(rows=pixels[0], columns=pixels[1])
            split.label(text=text, translate=False)
        else:
            numbers = split.row(align=True)
            numbers.use_property_split = False
            numbers.prop(settings, "width", text="X")
            numbers.prop(settings, "height", text="Y")
        row = layouts.invoking(layout.row())
        row.scale_y = 1.4
        row.enabled = _can_render(context)
        row.operator("mphdrr.render_projections", icon="RENDER_STILL")
        session = preview.session()
        row.operator("mphdrr.live_preview", text="", icon="HIDE_OFF", depress=session is not None)
        if session is not None:
            column = layout.column(align=True)
            column.active = False
            draw_text(column, session.problem)
            column.label(text=iface("{size} of voxels kept in memory").format(size=session.cache_size))
        if rendering.integrates_activity(context):
            draw_text(layout, "Line integrals of activity: for counts choose the model SPECT Counts.", icon="INFO")
        row = layout.row(align=True)
        for panel in ("MPHDRR_PT_physics", "MPHDRR_PT_advanced", "MPHDRR_PT_display"):
            row.popover(panel)


def _can_render(context: bpy.types.Context) -> bool:
    """Return whether the scene has a scanner and a volume."""
    return scanner.active_scanner(context.scene) is not None and bool(volumes.volume_objects(context.scene))


class MPHDRR_PT_physics(Popover, bpy.types.Panel):
    """Set photons, aperture, crystal and noise."""

    poll = layouts.shown_where(lambda context: context.scene.mphdrr_projections.model != "INVERSE_SQUARE")

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        layout.operator_menu_enum("mphdrr.use_preset", "preset", text="Presets", icon="PRESET")
        settings = context.scene.mphdrr_projections
        column = layout.column(align=True)
        if settings.model == "EMISSION":
            column.prop(settings, "mu", placeholder="None")
        physics = (setting for setting in panel_properties(settings, "model") if setting[0] in _PHYSICS)
        layouts.draw_settings(column, settings, physics)
        layouts.draw_settings(column, settings, panel_properties(settings, "scatter"))
        row = layout.row(heading="Poisson Noise")
        row.active = makes_counts(settings)
        row.prop(settings, "noise", text="")
        seed = row.row()
        seed.active = settings.noise
        seed.prop(settings, "seed")


class MPHDRR_PT_advanced(Popover, bpy.types.Panel):
    """Set what is rarely changed: the hole's edge, rays, the virtual detector, the modules, the backend."""

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        settings, collection = context.scene.mphdrr_projections, scanner.active_scanner(context.scene)
        column = layout.column(align=True)
        if settings.model == "EMISSION" and collection is not None:
            column.prop(collection.mphdrr_scanner, "opening_angle")
        for table in ("model", "frames", "detector", "compute"):
            rest = (setting for setting in panel_properties(settings, table) if setting[0] not in (*_MAIN, *_PHYSICS))
            layouts.draw_settings(column, settings, rest)
        column.prop(settings, "modules", placeholder="All")
        layout.operator("mphdrr.load_recipe", icon="FILE_FOLDER")


class MPHDRR_PT_export(Folded, bpy.types.Panel):
    bl_order = ids.ORDER_EXPORT

    poll = layouts.shown_where(lambda context: scanner.active_scanner(context.scene) is not None)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(self.layout)
        run_file = context.scene.mphdrr_projections.run_file
        both = layout.row(align=True)
        row = both.row(align=True)
        row.enabled = bool(run_file)
        row.operator("mphdrr.export_dataset", text="Export Dataset", icon="EXPORT")
        both.operator("mphdrr.export_figure", text="Export Figure", icon="IMAGE_DATA")
        both = layout.row(align=True)
        both.operator("mphdrr.render_picture")
        both.operator("mphdrr.render_animation")
        if run_file:
            text = run_file if run_file.startswith("//") else iface("Kept when the .blend is saved")
            layout.label(text=text, translate=False, icon="FILE")
        for line in runs.change_lines(context.scene):
            draw_text(layout, line)
