"""Menus Add > mphDRR, Object > mphDRR and Image > mphDRR Projections, with every command, so that the search (F3) finds it.

Commands that add something are under Add > mphDRR; those that read or write files are also under File
(`addon/registration.py`).
"""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender.layouts import invoking
from ..addon.phantoms.phantom_properties import menu_entries
from ..addon.scanner import selection


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
        layout.operator("mphdrr.import_geometry", icon="IMPORT")
        layout.operator("mphdrr.add_xray_system", icon="LIGHT_SPOT")
        layout.operator("mphdrr.export_geometry", icon="EXPORT")
        layout.operator("mphdrr.export_for_program")
        layout.separator()
        state = context.scene.mphdrr_geometry
        text = iface("Show Only Modules {first} to {last}").format(first=state.first, last=state.last)
        show = layout.operator("mphdrr.show_modules", text=text)
        show.first, show.last, show.mode = state.first, state.last, "ONLY"
        layout.operator("mphdrr.show_modules", text="Show All Modules", icon="HIDE_OFF").mode = "ALL"
        camera = selection.listed_module(context.scene)
        look = layout.operator("mphdrr.look_through_module", text="Look Through Active Module")
        look.number = camera.mphdrr_module.number if camera else 1
        layout.operator("mphdrr.isolate_ring")
        layout.separator()
        layout.operator("mphdrr.duplicate_modules", icon="DUPLICATE")
        layout.operator("mphdrr.remove_modules", icon="TRASH")
        layout.operator("mphdrr.aim_modules", icon="CON_TRACKTO")
        layout.operator("mphdrr.reset_cameras", icon="LOOP_BACK")
        layout.operator("mphdrr.tidy_modules", icon="BRUSH_DATA")
        layout.operator_menu_enum("mphdrr.renumber_modules", "order", icon="LINENUMBERS_ON")
        layout.separator()
        layout.operator("mphdrr.check_geometry", icon="CHECKMARK")
        layout.operator("mphdrr.optimise", icon="OPTIONS")
        layout.operator("mphdrr.calibrate", icon="TRACKER")
        layout.operator_menu_enum("mphdrr.add_map", "quantity", icon="OUTLINER_DATA_LIGHTPROBE")
        layout.separator()
        layout.operator("mphdrr.set_up_scene", icon="SCENE_DATA")
        layout.operator("mphdrr.remove_scanner", icon="TRASH")


class MPHDRR_MT_module(bpy.types.Menu):
    """Pie menu of the most frequent commands, which opens by a key (`addon/registration.py`)."""

    bl_label = "mphDRR Module"

    def draw(self, context: bpy.types.Context) -> None:
        pie = invoking(self.layout.menu_pie())  # entries to the west, east, south, north, and between them
        draw_module(pie, selection.active_module(context))
        pie.operator("mphdrr.render_projections", icon="RENDER_STILL")
        pie.operator("mphdrr.reconstruct", icon="OUTLINER_OB_VOLUME")
        pie.operator("mphdrr.show_modules", text="Show All Modules", icon="HIDE_OFF").mode = "ALL"
        pie.menu("MPHDRR_MT_commands", text="All Commands", icon="COLLAPSEMENU")


def draw_module(layout: bpy.types.UILayout, camera: bpy.types.Object | None) -> None:
    """Draw the commands that work on one module, given by its camera, or on module 1."""
    look = layout.operator("mphdrr.look_through_module", text="Look Through", icon="OUTLINER_OB_CAMERA")
    look.number = camera.mphdrr_module.number if camera else 1
    layout.operator("mphdrr.isolate_ring", icon="HIDE_OFF")
    layout.operator("mphdrr.live_preview", icon="VIEW_CAMERA")
    layout.operator("mphdrr.pick_pixel", icon="EYEDROPPER")


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
        layout.operator("mphdrr.update_phantom", icon="FILE_REFRESH")
        layout.operator("mphdrr.try_event")
        layout.operator("mphdrr.apply_phantom_pose", icon="OBJECT_ORIGIN")
        layout.operator("mphdrr.show_phantom_outline", text="Show or Hide Outline", icon="SHADING_WIRE")
        layout.separator()
        layout.operator("mphdrr.ct_to_attenuation", icon="MOD_FLUIDSIM")
        layout.operator_menu_enum("mphdrr.add_dose_map", "isotope", icon="OUTLINER_DATA_VOLUME")
        layout.operator("mphdrr.add_slices", icon="MESH_PLANE")
        layout.operator("mphdrr.remove_slices", icon="X")
        layout.operator("mphdrr.show_in_perspective", icon="VIEW_PERSPECTIVE")
        layout.operator("mphdrr.resample_in_perspective", icon="OUTLINER_DATA_VOLUME")
        layout.operator("mphdrr.clear_perspective", icon="X")
        layout.operator("mphdrr.voxelize_objects", icon="OUTLINER_DATA_MESH")
        layout.operator("mphdrr.mesh_from_volume", icon="MESH_DATA")
        layout.separator()
        layout.operator("mphdrr.export_volume", icon="EXPORT")
        layout.operator("mphdrr.remake_volumes", icon="FILE_REFRESH")
        layout.operator("mphdrr.find_volume_files", icon="VIEWZOOM")
        layout.operator("mphdrr.collect_files", icon="FILE_FOLDER")
        layout.operator("mphdrr.clean_volume_files", icon="TRASH")
        layout.operator("mphdrr.add_looks", icon="ASSET_MANAGER")


class MPHDRR_MT_projections(bpy.types.Menu):
    def draw(self, context: bpy.types.Context) -> None:
        layout = invoking(self.layout)
        layout.operator("mphdrr.render_projections", icon="RENDER_STILL")
        layout.operator("mphdrr.import_counts", icon="IMPORT")
        layout.operator("mphdrr.live_preview", icon="VIEW_CAMERA")
        layout.operator("mphdrr.show_projections", icon="IMAGE_DATA")
        layout.operator_menu_enum("mphdrr.pick_window", "end", icon="EYEDROPPER")
        layout.operator("mphdrr.pick_pixel", icon="EYEDROPPER")
        layout.operator("mphdrr.clear_pixel", icon="X")
        layout.separator()
        layout.operator("mphdrr.reconstruct", icon="OUTLINER_OB_VOLUME")
        layout.operator("mphdrr.continue_reconstruction", icon="FORWARD")
        layout.operator("mphdrr.show_reconstruction", icon="IMAGE_DATA")
        layout.operator("mphdrr.use_ct", icon="MOD_FLUIDSIM")
        layout.operator_menu_enum("mphdrr.backproject", "how", icon="OUTLINER_DATA_VOLUME")
        layout.separator()
        layout.operator_menu_enum("mphdrr.new_event_recipe", "like", icon="FILE_NEW")
        layout.operator("mphdrr.make_event_set", icon="FILE_CACHE")
        layout.operator("mphdrr.open_event", icon="OUTLINER_OB_VOLUME")
        layout.separator()
        settings = context.scene.mphdrr_projections
        layout.operator_menu_enum("mphdrr.compare_runs", "other", icon="SELECT_DIFFERENCE")
        layout.operator("mphdrr.flood_efficiency", icon="MESH_GRID")
        layout.operator("mphdrr.remove_run", icon="TRASH").index = settings.active_run
        layout.separator()
        layout.operator_menu_enum("mphdrr.use_preset", "preset", icon="PRESET")
        layout.operator("mphdrr.load_recipe", icon="FILE_FOLDER")
        layout.operator("mphdrr.export_dataset", icon="EXPORT")
        layout.operator("mphdrr.export_figure", icon="IMAGE_DATA")
        layout.operator("mphdrr.render_picture", icon="RENDER_STILL")
        layout.operator("mphdrr.render_animation", icon="RENDER_ANIMATION")
