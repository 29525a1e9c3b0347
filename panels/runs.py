"""The scene's runs in both sidebars: their list, the changes since the shown one was rendered, and the comparison of two."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, jobs, layouts
from ..addon.pictures import images
from ..addon.runs import runs
from .sidebar import Folded, ImagesSidebar, draw_text


class MPHDRR_UL_runs(bpy.types.UIList):
    """List of the runs, with a mark at the shown one, and a warning if the scene has changed since."""

    def draw_item(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, data: bpy.types.PropertyGroup,
        item: bpy.types.PropertyGroup, icon: int, active_data: bpy.types.PropertyGroup, active_property: str,
        index: int = 0, flt_flag: int = 0,
    ) -> None:  # fmt: skip
        row = layout.row(align=True)
        is_shown = item.file == data.run_file
        is_stale = is_shown and runs.has_scene_changed(context.scene)
        eye = "ERROR" if is_stale else "HIDE_OFF" if is_shown else "BLANK1"
        row.prop(item, "name", text="", emboss=False, icon=eye)
        row.prop(item, "keep", text="", icon="PINNED" if item.is_kept else "UNPINNED", emboss=False)


class _RunsPanel:
    """Mixin of panels that show the runs."""

    bl_label = "Runs"

    poll = layouts.shown_where(lambda context: context.scene.mphdrr_projections.runs)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout  # type: ignore[attr-defined]
        settings = context.scene.mphdrr_projections
        draw_changes(layout, context.scene)
        if text := runs.measured_text(context.scene):
            draw_text(layout, text, icon="INFO")
        row = layout.row()
        row.enabled = not jobs.is_running()
        row.template_list("MPHDRR_UL_runs", "", settings, "runs", settings, "active_run", rows=2, maxrows=6)
        buttons = layouts.invoking(row.column(align=True))
        buttons.operator("mphdrr.remove_run", text="", icon="REMOVE").index = settings.active_run
        column = layout.column(align=True)
        column.active = False
        for line in settings.run_summary.split(", ", 1):
            column.label(text=line)
        row = layouts.invoking(layout.row(align=True))
        row.operator("mphdrr.show_projections", text="Show Mosaic", icon="IMAGE_DATA")
        row = layouts.invoking(layout.row(align=True))
        row.enabled = not jobs.is_running()
        for part, label, is_shown in runs.parts_to_show(context.scene):
            button = row.operator("mphdrr.show_run", text=label, depress=is_shown)
            button.index, button.photons = settings.active_run, part
        if len(settings.runs) > 1:
            column.label(text=iface("All runs: {size}").format(size=runs.file_size_text(settings.runs)))
            row = row.row(align=True)
            row.enabled = not jobs.is_running()
            row.operator_menu_enum("mphdrr.compare_runs", "other", text="Compare With", icon="SELECT_DIFFERENCE")
            if text := images.difference_text():
                draw_text(layout, text, icon="INFO")


class MPHDRR_PT_runs(_RunsPanel, Folded, bpy.types.Panel):
    bl_order = ids.ORDER_RUNS


class MPHDRR_PT_runs_of_images(_RunsPanel, ImagesSidebar, bpy.types.Panel):
    """Show, keep, compare and remove the scene's runs."""


def draw_changes(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Draw the changes since the shown run was rendered, if any, and a button that renders again."""
    if not (lines := runs.change_lines(scene)):
        return
    box = layout.box()
    box.alert = runs.has_scene_changed(scene)
    heading = "Shown run:" if lines == [runs.UNKNOWN] else "Shown run, of other settings than the panel's:"
    draw_text(box, "Not of the scene as it is now:" if box.alert else heading, "ERROR" if box.alert else "INFO")
    column = box.column(align=True)
    for line in lines:
        draw_text(column, line, icon="DOT")
    if runs.measured_text(scene):
        return
    row = layouts.invoking(box.row())
    row.alert, row.enabled = False, not jobs.is_running()
    button = row.operator("mphdrr.render_projections", text="Render Again", icon="FILE_REFRESH")
    button.volume = runs.volume_to_render(scene)
