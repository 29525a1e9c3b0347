"""Sidebar, last step: the dataset."""

from __future__ import annotations

import bpy

from ..addon import ids


class MPHDRR_PT_export(bpy.types.Panel):
    bl_idname = ids.PANEL_EXPORT
    bl_label = "Export"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.CATEGORY
    bl_order = ids.ORDER_EXPORT

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_context = "INVOKE_DEFAULT"
        run_file = context.scene.mphdrr_projections.run_file
        row = layout.row()
        row.enabled = bool(run_file)
        row.operator(ids.EXPORT_DATASET, text="Export Dataset", icon="EXPORT")
        column = layout.column(align=True)
        column.active = False
        if not run_file:
            column.label(text="Render the projections first.", icon="INFO")
        else:
            kept = run_file if run_file.startswith("//") else "kept when the .blend is saved"
            column.label(text=f"Last run: {kept}", icon="FILE")
