"""Sidebar: the live preview of the active module."""

import textwrap

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids
from ..addon.runs import preview
from .geometry import Sidebar

_LINE = 34  # letters that fit into the sidebar at its usual width


class MPHDRR_PT_preview(Sidebar, bpy.types.Panel):
    bl_label = "Live Preview"
    bl_parent_id = "MPHDRR_PT_projections"

    def draw(self, context: bpy.types.Context) -> None:
        layout, session = self.layout, preview.session()
        layout.operator(ids.LIVE_PREVIEW, icon="HIDE_OFF", depress=session is not None)
        if session is None:
            return
        column = layout.column(align=True)
        column.active = False
        if session.problem:
            for line in textwrap.wrap(session.problem, _LINE):
                column.label(text=line)
        column.label(text=iface("{size} of voxels kept in memory").format(size=session.kept))
