"""Sidebar, second step: the phantom."""

from __future__ import annotations

import bpy

from ..addon import ids, volumes


class MPHDRR_PT_phantom(bpy.types.Panel):
    bl_idname = ids.PANEL_PHANTOM
    bl_label = "Phantom"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.CATEGORY
    bl_order = ids.ORDER_PHANTOM

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_context = "INVOKE_DEFAULT"
        layout.operator(ids.ADD_DERENZO, text="Add Derenzo Phantom", icon="OUTLINER_DATA_VOLUME")
        item = context.object
        if not volumes.is_volume(item):
            column = layout.column(align=True)
            column.active = False
            known = volumes.volume_objects(context.scene)
            column.label(
                text="Select a volume to see its numbers." if known else "No volume in the scene.", icon="INFO"
            )
            return
        settings = getattr(item, ids.OBJECT_VOLUME)
        split = layout.split(factor=0.34)
        names, values = split.column(align=True), split.column(align=True)
        names.active = False
        shape, spacing = settings.shape, settings.spacing
        for name, value in (
            ("Volume", item.name),
            ("Holds", f"{settings.quantity}, {settings.unit}"),
            ("Voxels", " × ".join(map(str, shape))),
            ("Size", " × ".join(f"{s:.3g}" for s in spacing) + " mm"),
            ("Maximum", f"{settings.maximum:.4g}"),
        ):
            names.label(text=name)
            values.label(text=value)
        layout.use_property_split = True
        layout.use_property_decorate = False
        if settings.kind == "DERENZO":
            settings.derenzo.draw_settings(layout)
            layout.operator(ids.UPDATE_DERENZO, icon="FILE_REFRESH")
