"""Add > mphDRR, Object > mphDRR, and Image > mphDRR Projections: every command, so that the menus' search (F3) finds it.

What adds something is under Add > mphDRR, what reads and writes files also under File (`addon/registration.py`).
"""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids
from ..addon.blender.layouts import invoking
from ..addon.phantoms.phantom_properties import menu_entries
from ..addon.scanner import selection


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


class MPHDRR_MT_commands(bpy.types.Menu):
    bl_label = "mphDRR"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.menu("MPHDRR_MT_modules", icon="OUTLINER_OB_CAMERA")
        layout.menu("MPHDRR_MT_volumes", icon="OUTLINER_DATA_VOLUME")
        layout.menu("MPHDRR_MT_projections", icon="RENDER_STILL")
        layout.separator()
        layout.operator(ids.LOAD_EXAMPLE, icon="PLAY")


class MPHDRR_MT_modules(bpy.types.Menu):
    bl_label = "Modules and Collimators"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.operator(ids.IMPORT_GEOMETRY, icon="IMPORT")
        layout.operator(ids.EXPORT_GEOMETRY, icon="EXPORT")
        layout.operator(ids.EXPORT_FOR_PROGRAM)
        layout.separator()
        state = context.scene.mphdrr_geometry
        text = iface("Show Only Modules {first} to {last}").format(first=state.first, last=state.last)
        shown = layout.operator(ids.SHOW_MODULES, text=text)
        shown.first, shown.last, shown.mode = state.first, state.last, "ONLY"
        layout.operator(ids.SHOW_MODULES, text="Show All Modules", icon="HIDE_OFF").mode = "ALL"
        camera = selection.listed_module(context.scene)
        look = layout.operator(ids.LOOK_THROUGH_MODULE, text="Look Through Active Module")
        look.number = camera.mphdrr_module.number if camera else 1
        layout.separator()
        layout.operator(ids.DUPLICATE_MODULES, icon="DUPLICATE")
        layout.operator(ids.REMOVE_MODULES, icon="TRASH")
        layout.operator(ids.AIM_MODULES, icon="CON_TRACKTO")
        layout.operator(ids.RESET_CAMERAS, icon="LOOP_BACK")
        layout.operator(ids.TIDY_MODULES, icon="BRUSH_DATA")
        layout.operator_menu_enum(ids.RENUMBER_MODULES, "order", icon="LINENUMBERS_ON")
        layout.separator()
        layout.operator(ids.CHECK_GEOMETRY, icon="CHECKMARK")
        layout.operator_menu_enum(ids.ADD_MAP, "quantity", icon="OUTLINER_DATA_LIGHTPROBE")
        layout.separator()
        layout.operator(ids.SET_UP_SCENE, icon="SCENE_DATA")
        layout.operator(ids.REMOVE_SCANNER, icon="TRASH")


class MPHDRR_MT_volumes(bpy.types.Menu):
    bl_label = "Phantoms and Volumes"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.menu("MPHDRR_MT_add", text="Add Phantom or Volume", icon="ADD")
        layout.separator()
        layout.operator(ids.UPDATE_PHANTOM, icon="FILE_REFRESH")
        layout.operator(ids.TRY_EVENT)
        layout.operator(ids.APPLY_PHANTOM_POSE, icon="OBJECT_ORIGIN")
        layout.operator(ids.SHOW_PHANTOM_OUTLINE, text="Show or Hide Outline", icon="SHADING_WIRE")
        layout.separator()
        layout.operator(ids.CT_TO_ATTENUATION, icon="MOD_FLUIDSIM")
        layout.operator(ids.ADD_SLICES, icon="MESH_PLANE")
        layout.operator(ids.REMOVE_SLICES, icon="X")
        layout.operator(ids.SHOW_IN_PERSPECTIVE, icon="VIEW_PERSPECTIVE")
        layout.operator(ids.RESAMPLE_IN_PERSPECTIVE, icon="OUTLINER_DATA_VOLUME")
        layout.operator(ids.CLEAR_PERSPECTIVE, icon="X")
        layout.operator(ids.VOXELIZE_OBJECTS, icon="OUTLINER_DATA_MESH")
        layout.operator(ids.MESH_FROM_VOLUME, icon="MESH_DATA")
        layout.separator()
        layout.operator(ids.EXPORT_VOLUME, icon="EXPORT")
        layout.operator(ids.REMAKE_VOLUMES, icon="FILE_REFRESH")
        layout.operator(ids.FIND_VOLUME_FILES, icon="VIEWZOOM")
        layout.operator(ids.CLEAN_VOLUME_FILES, icon="TRASH")


class MPHDRR_MT_projections(bpy.types.Menu):
    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.operator(ids.RENDER_PROJECTIONS, icon="RENDER_STILL")
        layout.operator(ids.IMPORT_COUNTS, icon="IMPORT")
        layout.operator(ids.LIVE_PREVIEW, icon="VIEW_CAMERA")
        layout.operator(ids.SHOW_PROJECTIONS, icon="IMAGE_DATA")
        layout.operator_menu_enum(ids.PICK_WINDOW, "end", icon="EYEDROPPER")
        layout.operator(ids.PICK_PIXEL, icon="EYEDROPPER")
        layout.operator(ids.CLEAR_PIXEL, icon="X")
        layout.separator()
        layout.operator(ids.RECONSTRUCT, icon="OUTLINER_OB_VOLUME")
        layout.operator(ids.SHOW_RECONSTRUCTION, icon="IMAGE_DATA")
        layout.operator_menu_enum(ids.BACKPROJECT, "how", icon="OUTLINER_DATA_VOLUME")
        layout.separator()
        layout.operator_menu_enum(ids.NEW_EVENT_RECIPE, "like", icon="FILE_NEW")
        layout.operator(ids.MAKE_EVENT_SET, icon="FILE_CACHE")
        layout.operator(ids.OPEN_EVENT, icon="OUTLINER_OB_VOLUME")
        layout.separator()
        settings = context.scene.mphdrr_projections
        layout.operator_menu_enum(ids.COMPARE_RUNS, "other", icon="SELECT_DIFFERENCE")
        layout.operator(ids.REMOVE_RUN, icon="TRASH").index = settings.active_run
        layout.separator()
        layout.operator_menu_enum(ids.USE_PRESET, "preset", icon="PRESET")
        layout.operator(ids.LOAD_RECIPE, icon="FILE_FOLDER")
        layout.operator(ids.EXPORT_DATASET, icon="EXPORT")
        layout.operator(ids.EXPORT_FIGURE, icon="IMAGE_DATA")
