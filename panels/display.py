"""Display settings of the projections, in the 3D view's sidebar and in the Image Editor's, beside the pictures."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, layouts
from ..addon.pictures import images, tiles
from ..addon.scanner import selection
from .sidebar import ImagesSidebar, Popover, draw_facts


class _DisplayPanel:
    """Mixin of panels with the settings of colours and window."""

    bl_label = "Display"

    poll = layouts.shown_where(lambda context: ids.MOSAIC in bpy.data.images)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)  # type: ignore[attr-defined]
        settings = context.scene.mphdrr_display
        column = layout.column(align=True)
        layouts.draw_all(column, settings, "colors", "scale")
        column.prop(settings, "automatic", text="Automatic Window")
        for name, text in () if settings.automatic else (("low", "Low"), ("high", "High")):
            row = column.row(align=True)
            row.prop(settings, name, text=text)
            row.operator("mphdrr.pick_window", text="", icon="EYEDROPPER").end = name.upper()
        column.prop(settings, "region")
        if settings.problem:
            layout.label(text=settings.problem, icon="ERROR")
        _draw_totals(layout, context)


def _draw_totals(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw total and maximum of the active module's projection."""
    mosaic, camera = bpy.data.images[ids.MOSAIC], selection.active_module(context)
    summary, index = images.tiles(mosaic) or {}, tiles.active_tile(context, mosaic)
    if camera is None or index is None or "totals" not in summary:
        return
    column = layout.column(align=True)
    text = iface("{name}, central half ({unit})") if summary["half"] else "{name} ({unit})"
    column.label(text=text.format(name=camera.name, unit=tiles.unit()).removesuffix(" ()"), translate=False)
    numbers = column.split(factor=0.4)
    numbers.active = False
    total, maximum = (images.number_text(summary[name][index], 6) for name in ("totals", "maxima"))
    draw_facts(numbers, (summary["summed"].capitalize(), total), ("Maximum", maximum))


class MPHDRR_PT_display(_DisplayPanel, Popover, bpy.types.Panel):
    """Set colours and window of the last run's pictures, and their place in the scene."""

    def draw(self, context: bpy.types.Context) -> None:
        _DisplayPanel.draw(self, context)
        layout, settings = self.layout, context.scene.mphdrr_display
        column = layout.column(align=True)
        column.prop(settings, "planes")
        if settings.planes != "NONE":
            column.prop(settings, "plane_at_detector")
        if settings.planes != "NONE" and not settings.plane_at_detector:
            column.prop(settings, "plane_distance")
        layouts.draw_all(column, settings, "backgrounds", "plane_opacity")


class MPHDRR_PT_display_of_images(_DisplayPanel, ImagesSidebar, bpy.types.Panel):
    """Set colours and window of the pictures."""
