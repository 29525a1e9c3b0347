"""Sidebar, third step: the projections."""

from __future__ import annotations

import bpy

from ..addon import ids, jobs, scanner, volumes


class MPHDRR_PT_projections(bpy.types.Panel):
    bl_idname = ids.PANEL_PROJECTIONS
    bl_label = "Projections"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.CATEGORY
    bl_order = ids.ORDER_PROJECTIONS

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = getattr(context.scene, ids.SCENE_PROJECTIONS)
        jobs.draw_job(layout, context)  # at the top, where it is seen on small screens too
        column = layout.column()
        column.enabled = not jobs.is_running()
        column.prop(settings, "volume", placeholder="Active volume")
        column.prop(settings, "model")
        _draw_ct_hint(column, settings, context.object)
        if settings.model == "EMISSION":
            column.prop(settings, "time")
        elif settings.model == "TRANSMISSION":
            column.prop(settings, "photons")
        size = column.column(align=True)
        size.prop(settings, "width", text="Pixels X")
        size.prop(settings, "height", text="Y")
        column.row().prop(settings, "detector", expand=True)
        column.prop(settings, "magnification")
        if settings.model != "INVERSE_SQUARE":
            column.prop(settings, "pixel_points")
        modules = column.column(align=True)
        modules.prop(settings, "first", text="Modules First")
        modules.prop(settings, "last", text="Last")
        column.prop(settings, "backend")
        if not jobs.is_running():
            row = layout.row()
            row.scale_y = 1.4
            row.operator_context = "INVOKE_DEFAULT"
            ready = scanner.active_scanner(context.scene) is not None and bool(volumes.volume_objects(context.scene))
            row.enabled = ready
            row.operator(ids.RENDER_PROJECTIONS, icon="RENDER_STILL")
            if not ready:
                hint = layout.row()
                hint.active = False
                hint.label(text="Needs a scanner and a volume.", icon="INFO")
        if settings.run_file:
            layout.operator(ids.SHOW_PROJECTIONS, text="Show Mosaic", icon="IMAGE_DATA")
            column = layout.column(align=True)
            column.active = False
            for part in settings.run_summary.split(", ", 1):
                column.label(text=part)


def _draw_ct_hint(
    layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, active: bpy.types.Object | None
) -> None:
    """A CT that would be projected has to be converted first."""
    item = settings.volume or active
    if settings.model == "EMISSION" or not volumes.is_volume(item) or volumes.quantity_of(item) != "hu":
        return
    column = layout.column(align=True)
    column.label(text="CT numbers have no radiograph", icon="ERROR")
    if item == active:
        column.operator_context = "INVOKE_DEFAULT"
        column.operator(ids.CT_TO_ATTENUATION)
    else:
        column.label(text="Select the CT, convert it", icon="BLANK1")


class MPHDRR_PT_physics(bpy.types.Panel):
    bl_idname = ids.PANEL_PHYSICS
    bl_label = "Physics"
    bl_parent_id = ids.PANEL_PROJECTIONS
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.CATEGORY
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _makes_counts(getattr(context.scene, ids.SCENE_PROJECTIONS))

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.enabled = not jobs.is_running()
        settings = getattr(context.scene, ids.SCENE_PROJECTIONS)
        if settings.model == "EMISSION":
            column = layout.column()
            column.prop(settings, "isotope")
            column.prop(settings, "mu", placeholder="None")
            column = layout.column(align=True)
            column.prop(settings, "aperture_points")
            column.prop(settings, "aperture_material", text="Edge of")
            if settings.aperture_material == "NUMBER":
                column.prop(settings, "aperture_mu", text="Edge µ (1/mm)")
            edge = column.column(align=True)
            edge.active = settings.aperture_material != "NUMBER" or settings.aperture_mu > 0
            edge.prop(settings, "edge")
            collection = scanner.active_scanner(context.scene)
            if collection is not None:
                column.prop(collection.mphdrr_scanner, "opening_angle")
            column = layout.column(align=True)
            column.prop(settings, "crystal_material")
            if settings.crystal_material == "NUMBER":
                column.prop(settings, "crystal_mu", text="Crystal µ (1/mm)")
            depth = column.column(align=True)
            depth.active = settings.crystal_material != "NUMBER" or settings.crystal_mu > 0
            depth.prop(settings, "depth_layers")
            column.prop(settings, "intrinsic_fwhm", text="Blur (mm)")
            column = layout.column(heading="Stopped by", align=True)
            for name in ("within_cone", "within_walls", "within_crystal"):
                column.prop(settings, name)
        row = layout.row(heading="Poisson Noise")
        row.prop(settings, "noise", text="")
        seed = row.row()
        seed.active = settings.noise
        seed.prop(settings, "seed")


def _makes_counts(settings: bpy.types.PropertyGroup) -> bool:
    """Whether images hold numbers of photons."""
    return settings.model == "EMISSION" or (settings.model == "TRANSMISSION" and settings.photons > 0)
