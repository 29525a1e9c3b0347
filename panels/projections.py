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
        if settings.model == "EMISSION":
            column.prop(settings, "time")
        size = column.column(align=True)
        size.prop(settings, "width", text="Pixels X")
        size.prop(settings, "height", text="Y")
        column.row().prop(settings, "detector", expand=True)
        column.prop(settings, "magnification")
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
