"""Gizmos in the 3D view by which the mouse moves the active volume's slices."""

import bpy
from mathutils import Matrix, Vector

from ..addon.blender.layouts import shown_where
from ..addon.volumes import slices

_COLORS = ((1.0, 0.2, 0.32), (0.55, 0.86, 0.0), (0.16, 0.56, 1.0))  # the colours of Blender's axes


class MPHDRR_GGT_slices(bpy.types.GizmoGroup):
    """Gizmo group with an arrow at a corner of each slice."""

    bl_idname = "MPHDRR_GGT_slices"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"3D", "PERSISTENT"}

    poll = shown_where(lambda context: slices.active_sliced_volume(context) is not None)

    def setup(self, context: bpy.types.Context) -> None:
        for axis, color in enumerate(_COLORS):
            arrow = self.gizmos.new("GIZMO_GT_arrow_3d")
            arrow.color, arrow.alpha = color, 0.7
            arrow.color_highlight, arrow.alpha_highlight = color, 1.0
            arrow.use_draw_modal = True

            def get(axis: int = axis) -> float:
                """Return the handle's position along the axis."""
                if (item := slices.active_sliced_volume(bpy.context)) is None:
                    return 0.0
                return slices.slice_track(item, axis)[1].length * item.mphdrr_volume.slices[axis]

            def set(value: float, axis: int = axis) -> None:
                """Move the slice of the axis to the handle's position."""
                if (item := slices.active_sliced_volume(bpy.context)) is not None:
                    slices.move_slice(item, axis, value / slices.slice_track(item, axis)[1].length)

            arrow.target_set_handler("offset", get=get, set=set)

    def draw_prepare(self, context: bpy.types.Context) -> None:
        item = slices.active_sliced_volume(context)
        for axis, arrow in enumerate(self.gizmos if item is not None else ()):
            start, step = slices.slice_track(item, axis)
            turn = Vector((0.0, 0.0, 1.0)).rotation_difference(step).to_matrix().to_4x4()
            arrow.matrix_basis = Matrix.Translation(start) @ turn
