"""The picked pixel, its ray and its epipolar lines, in the 3D view's sidebar and in the Image Editor's."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, layouts
from ..addon.perspective import epipolar
from .sidebar import ImagesSidebar, Sidebar, draw_facts, draw_text


class _EpipolarPanel:
    """Mixin of panels that show the picked pixel."""

    bl_label = "Epipolar Lines"
    bl_options = {"DEFAULT_CLOSED"}

    poll = layouts.shown_where(lambda context: ids.MOSAIC in bpy.data.images)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)  # type: ignore[attr-defined]
        settings = context.scene.mphdrr_epipolar
        row = layouts.invoking(layout.row(align=True))
        row.operator("mphdrr.pick_pixel", icon="EYEDROPPER")
        row.operator("mphdrr.clear_pixel", text="", icon="X")
        if (run := epipolar.run_views(context.scene)) is None or settings.views != run.name:
            return
        layout.prop(settings, "module")
        row = layout.row(align=True)
        row.use_property_split = False
        layouts.draw_all(row, settings, "column", "row")
        pixel, problem = epipolar.picked_or_problem(context.scene)
        if problem:
            draw_text(layout, problem)
        if pixel is None:
            return
        column = layout.column(align=True)
        column.prop(settings, "along", slider=True)
        column.prop(settings, "k")
        draw_facts(
            layout.split(factor=0.4),
            ("Depth", f"{pixel.depth:.2f} mm"),
            ("Marker", ", ".join(f"{x:.2f}" for x in pixel.marker) + " mm"),
            ("Seen by", iface("{seen} of {count} modules").format(seen=pixel.seen_by, count=len(pixel.run.numbers))),
        )


class MPHDRR_PT_epipolar(_EpipolarPanel, Sidebar, bpy.types.Panel):
    bl_parent_id = "MPHDRR_PT_projections"


class MPHDRR_PT_epipolar_of_images(_EpipolarPanel, ImagesSidebar, bpy.types.Panel):
    """Show the picked pixel's ray and its epipolar lines."""
