"""Sidebar, Next Step: the stages that the scene has reached, the running job, and the button of the next step."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon import next_step
from ..addon.blender import ids, jobs, layouts
from .sidebar import Sidebar, draw_text


class MPHDRR_PT_next_step(Sidebar, bpy.types.Panel):
    bl_order = ids.ORDER_NEXT

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        self.layout.operator("wm.url_open", text="Tutorial", icon="HELP", emboss=False).url = next_step.tutorial()

    def draw(self, context: bpy.types.Context) -> None:
        layout, step = layouts.invoking(self.layout), next_step.next_step(context)
        is_empty = step.operator == "mphdrr.load_example"
        column = layout.column(align=True)
        for stage in () if is_empty else next_step.work_stages(context):
            _draw_stage(column, stage)
        if jobs.is_running():
            jobs.draw_job(layout)
            return
        row = layout.row(align=True)
        row.scale_y = 1.6
        if step.item is not None:
            row.context_pointer_set("object", step.item)
        button = row.operator(step.operator, text=step.text, icon=step.icon)
        for name, value in step.settings.items():
            setattr(button, name, value)
        if step.operator == "mphdrr.add_derenzo":
            row.menu("MPHDRR_MT_add", text="", icon="DOWNARROW_HLT")
        elif is_empty:
            layout.operator("mphdrr.load_example", text="X-ray Inside SPECT", icon="PLAY").example = "XRAY"
            layout.operator("mphdrr.import_geometry", text="Import Geometry", icon="IMPORT")


def _draw_stage(layout: bpy.types.UILayout, stage: next_step.WorkStage) -> None:
    """Draw a stage's name with a mark: reached, out of date, or still open."""
    column = layout.column(align=True)
    column.active, column.alert = bool(stage.note), stage.is_stale
    icon = "ERROR" if stage.is_stale else "CHECKMARK" if stage.note else "RADIOBUT_OFF"
    text = iface("{stage}: {note}").format(stage=iface(stage.name), note=stage.note) if stage.note else stage.name
    draw_text(column, text, icon)
