"""Sidebar, in Phantom: the active volume as the active module sees it."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, jobs
from ..addon.blender.layouts import draw_all, invoking, labelled
from ..addon.perspective import frustums
from ..addon.scanner import selection
from ..addon.volumes import volumes
from .geometry import Sidebar, draw_hint, draw_text


class MPHDRR_PT_perspective(Sidebar, bpy.types.Panel):
    bl_parent_id = "MPHDRR_PT_phantom"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(labelled(self.layout))
        settings, camera = context.scene.mphdrr_perspective, selection.active_module(context)
        if camera is None:
            draw_hint(layout, "Import a geometry first.")
            return
        jobs.draw_job(layout)
        name = context.object.name if volumes.is_volume(context.object) else iface("no volume is selected")
        text = iface("{volume}, by {module}").format(volume=name, module=camera.name)
        layout.label(text=text, translate=False, icon="VIEW_PERSPECTIVE")
        draw_all(layout.column(align=True), settings, "uniform", "planes")
        row = layout.row(align=True)
        row.operator(ids.SHOW_IN_PERSPECTIVE)
        row.operator(ids.CLEAR_PERSPECTIVE, text="", icon="X")
        for frustum in frustums.frustums(context.scene):
            _draw_frustum(layout.column(align=True), context.scene, frustum)
        layout.prop(settings, "cells")
        layout.operator(ids.RESAMPLE_IN_PERSPECTIVE)


def _draw_frustum(column: bpy.types.UILayout, scene: bpy.types.Scene, frustum: bpy.types.Object) -> None:
    """What is shown, and what has changed since."""
    module = "?" if frustum.parent is None else frustum.parent.name
    text = iface("Shown: {volume}, by {module}").format(volume=frustums.volume_of(frustum), module=module)
    column.label(text=text, translate=False)
    if changed := frustums.changes(scene, frustum):
        column.alert = True
        draw_text(column, iface("Not as it is now: {text}").format(text=changed), "ERROR")
