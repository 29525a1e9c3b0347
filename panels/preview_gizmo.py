"""Gizmo by which the mouse drags the live preview's box in the 3D view."""

from typing import Any

import bpy

from ..addon.blender.layouts import shown_where
from ..addon.runs import preview, preview_drawing


class MPHDRR_GT_preview(bpy.types.Gizmo):
    """Gizmo of the live preview's box, which `preview_drawing` draws."""

    bl_idname = "MPHDRR_GT_preview"

    def draw(self, context: bpy.types.Context) -> None:
        if self.is_highlight:
            preview_drawing.outline(context.region)

    def test_select(self, context: bpy.types.Context, location: Any) -> int:
        return 0 if preview_drawing.is_over(context.region, *location) else -1

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._mouse = event.mouse_x, event.mouse_y
        self._start = tuple(context.scene.mphdrr_display.preview_place)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event, tweak: set[str]) -> set[str]:
        preview_drawing.drag(context, self._start, (event.mouse_x - self._mouse[0], event.mouse_y - self._mouse[1]))
        return {"RUNNING_MODAL"}

    def exit(self, context: bpy.types.Context, cancel: bool) -> None:
        if cancel:
            preview_drawing.drag(context, self._start, (0.0, 0.0))


class MPHDRR_GGT_preview(bpy.types.GizmoGroup):
    """Gizmo group with the box of the live preview."""

    bl_idname = "MPHDRR_GGT_preview"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"PERSISTENT"}

    poll = shown_where(lambda context: preview.session() is not None)

    def setup(self, context: bpy.types.Context) -> None:
        self.gizmos.new("MPHDRR_GT_preview")
