"""Add > mphDRR: everything that can be put into the scanner."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids
from ..addon.blender.layouts import invoking
from ..addon.phantoms.phantom_properties import menu_entries


class MPHDRR_MT_add(bpy.types.Menu):
    bl_label = "mphDRR"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        for kind, label, beats in menu_entries():
            layout.operator(ids.ADD_PHANTOM + kind, text=label, icon="OUTLINER_DATA_VOLUME")
            if beats:
                text = iface("Beating {phantom}").format(phantom=iface(label))
                layout.operator(ids.ADD_PHANTOM + kind, text=text, icon="OUTLINER_DATA_VOLUME").frames = 24
        layout.operator(ids.IMPORT_PHANTOM, text="Phantom from TOML File", icon="FILE_TEXT")
        layout.separator()
        layout.operator(ids.IMPORT_VOLUME, text="Volume from File", icon="IMPORT")
        layout.operator(ids.IMPORT_VOLUME_SEQUENCE, text="Volume Sequence from Files", icon="RENDER_ANIMATION")
        layout.operator(ids.VOXELIZE_OBJECTS, text="Volume from Meshes", icon="OUTLINER_DATA_MESH")
        layout.operator(ids.ADD_MAP, text="Map of the Scanner", icon="OUTLINER_DATA_LIGHTPROBE")
