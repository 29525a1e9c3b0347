"""Menus Add > mphDRR, Object > mphDRR and Image > mphDRR Projections, with every command, so that the search (F3) finds it.

Commands that add something are under Add > mphDRR; those that read or write files are also under File
(`addon/registration.py`).
"""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender.layouts import invoking
from ..addon.phantoms.phantom_properties import menu_entries
from ..addon.scanner import selection


def draw_commands(layout: bpy.types.UILayout, **icons: str) -> None:
    """Draw entries of commands, given by their operators' names and icons, without values of their own."""
    for name, icon in icons.items():
        layout.operator(f"mphdrr.{name}", icon=icon)


class MPHDRR_MT_add(bpy.types.Menu):
    bl_label = "mphDRR"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        for kind, label, beats in menu_entries():
            layout.operator("mphdrr.add_" + kind, text=label, icon="OUTLINER_DATA_VOLUME")
            if beats:
                text = iface("Beating {phantom}").format(phantom=iface(label))
                layout.operator("mphdrr.add_" + kind, text=text, icon="OUTLINER_DATA_VOLUME").frames = 24
        layout.operator("mphdrr.import_phantom", text="Phantom from TOML File", icon="FILE_TEXT")
        layout.separator()
        layout.operator("mphdrr.import_volume", text="Volume from File", icon="IMPORT")
        layout.operator("mphdrr.import_volume_sequence", text="Volume Sequence from Files", icon="RENDER_ANIMATION")
        layout.operator("mphdrr.voxelize_objects", text="Volume from Meshes", icon="OUTLINER_DATA_MESH")
        layout.operator("mphdrr.add_map", text="Map of the Scanner", icon="OUTLINER_DATA_LIGHTPROBE")


class MPHDRR_MT_commands(bpy.types.Menu):
    bl_label = "mphDRR"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.menu("MPHDRR_MT_modules", icon="OUTLINER_OB_CAMERA")
        layout.menu("MPHDRR_MT_volumes", icon="OUTLINER_DATA_VOLUME")
        layout.menu("MPHDRR_MT_projections", icon="RENDER_STILL")
        layout.separator()
        layout.operator("mphdrr.load_example", icon="PLAY")
        layout.operator("mphdrr.load_example", text="Load Example: X-ray Inside SPECT", icon="PLAY").example = "XRAY"


class MPHDRR_MT_modules(bpy.types.Menu):
    bl_label = "Modules and Collimators"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        draw_commands(layout, import_geometry="IMPORT", add_xray_system="LIGHT_SPOT", export_geometry="EXPORT")
        draw_commands(layout, export_for_program="NONE")
        layout.separator()
        layout.operator("mphdrr.show_modules", text="Show All Modules", icon="HIDE_OFF").mode = "ALL"
        camera = selection.listed_module(context.scene)
        look = layout.operator("mphdrr.look_through_module", text="Look Through Active Module")
        look.number = camera.mphdrr_module.number if camera else 1
        layout.operator("mphdrr.isolate_ring")
        layout.separator()
        draw_commands(layout, duplicate_modules="DUPLICATE", remove_modules="TRASH", aim_modules="CON_TRACKTO")
        draw_commands(layout, reset_cameras="LOOP_BACK", tidy_modules="BRUSH_DATA")
        layout.operator_menu_enum("mphdrr.renumber_modules", "order", icon="LINENUMBERS_ON")
        layout.separator()
        draw_commands(layout, check_geometry="CHECKMARK", optimise="OPTIONS", calibrate="TRACKER")
        layout.operator_menu_enum("mphdrr.add_map", "quantity", icon="OUTLINER_DATA_LIGHTPROBE")
        layout.separator()
        draw_commands(layout, set_up_scene="SCENE_DATA", remove_scanner="TRASH")


class MPHDRR_MT_module(bpy.types.Menu):
    """Pie menu of the most frequent commands, which opens by a key (`addon/registration.py`)."""

    bl_label = "mphDRR Module"

    def draw(self, context: bpy.types.Context) -> None:
        pie = invoking(self.layout.menu_pie())  # entries to the west, east, south, north, and between them
        draw_module(pie, selection.active_module(context))
        draw_commands(pie, render_projections="RENDER_STILL", reconstruct="OUTLINER_OB_VOLUME")
        pie.operator("mphdrr.show_modules", text="Show All Modules", icon="HIDE_OFF").mode = "ALL"
        pie.menu("MPHDRR_MT_commands", text="All Commands", icon="COLLAPSEMENU")


def draw_module(layout: bpy.types.UILayout, camera: bpy.types.Object | None) -> None:
    """Draw the commands that work on one module, given by its camera, or on module 1."""
    look = layout.operator("mphdrr.look_through_module", text="Look Through", icon="OUTLINER_OB_CAMERA")
    look.number = camera.mphdrr_module.number if camera else 1
    draw_commands(layout, isolate_ring="HIDE_OFF", live_preview="VIEW_CAMERA", pick_pixel="EYEDROPPER")


def draw_in_context_menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    """Draw the active module's commands in Blender's context menu of an object."""
    if (camera := selection.module_of(context.object)) is not None:
        menu.layout.separator()
        draw_module(invoking(menu.layout), camera)


class MPHDRR_MT_volumes(bpy.types.Menu):
    bl_label = "Phantoms and Volumes"

    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.menu("MPHDRR_MT_add", text="Add Phantom or Volume", icon="ADD")
        layout.separator()
        draw_commands(layout, update_phantom="FILE_REFRESH", try_event="NONE", apply_phantom_pose="OBJECT_ORIGIN")
        layout.operator("mphdrr.show_phantom_outline", text="Show or Hide Outline", icon="SHADING_WIRE")
        layout.separator()
        layout.operator("mphdrr.ct_to_attenuation", icon="MOD_FLUIDSIM")
        layout.operator_menu_enum("mphdrr.add_dose_map", "isotope", icon="OUTLINER_DATA_VOLUME")
        draw_commands(layout, add_slices="MESH_PLANE", remove_slices="X", show_in_perspective="VIEW_PERSPECTIVE")
        draw_commands(layout, resample_in_perspective="OUTLINER_DATA_VOLUME", clear_perspective="X")
        draw_commands(layout, voxelize_objects="OUTLINER_DATA_MESH", mesh_from_volume="MESH_DATA")
        layout.separator()
        draw_commands(layout, export_volume="EXPORT", remake_volumes="FILE_REFRESH", find_volume_files="VIEWZOOM")
        draw_commands(layout, collect_files="FILE_FOLDER", clean_volume_files="TRASH", add_looks="ASSET_MANAGER")


class MPHDRR_MT_projections(bpy.types.Menu):
    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        draw_commands(layout, render_projections="RENDER_STILL", import_counts="IMPORT", live_preview="VIEW_CAMERA")
        draw_commands(layout, show_projections="IMAGE_DATA")
        layout.operator_menu_enum("mphdrr.pick_window", "end", icon="EYEDROPPER")
        draw_commands(layout, pick_pixel="EYEDROPPER", clear_pixel="X")
        layout.separator()
        draw_commands(layout, reconstruct="OUTLINER_OB_VOLUME", continue_reconstruction="FORWARD")
        draw_commands(layout, show_reconstruction="IMAGE_DATA", use_ct="MOD_FLUIDSIM")
        layout.operator_menu_enum("mphdrr.backproject", "how", icon="OUTLINER_DATA_VOLUME")
        layout.separator()
        layout.operator_menu_enum("mphdrr.new_event_recipe", "like", icon="FILE_NEW")
        draw_commands(layout, make_event_set="FILE_CACHE", open_event="OUTLINER_OB_VOLUME")
        layout.separator()
        settings = context.scene.mphdrr_projections
        layout.operator_menu_enum("mphdrr.compare_runs", "other", icon="SELECT_DIFFERENCE")
        layout.operator("mphdrr.flood_efficiency", icon="MESH_GRID")
        layout.operator("mphdrr.remove_run", icon="TRASH").index = settings.active_run
        layout.separator()
        layout.operator_menu_enum("mphdrr.use_preset", "preset", icon="PRESET")
        draw_commands(layout, load_recipe="FILE_FOLDER", export_dataset="EXPORT", export_figure="IMAGE_DATA")
        draw_commands(layout, render_picture="RENDER_STILL", render_animation="RENDER_ANIMATION")
