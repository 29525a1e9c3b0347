"""Sidebar, Geometry: the scanner and the list of its modules."""

import bpy
import numpy as np
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, layouts
from ..addon.scanner import following, pinholes, scanner, selection
from ..addon.scanner.module_values import kind_of
from .sidebar import Folded, draw_facts, draw_text


class MPHDRR_UL_modules(bpy.types.UIList):
    """List of the modules among a scanner's objects, by number."""

    def draw_item(
        self, context: bpy.types.Context, layout: bpy.types.UILayout, data: bpy.types.Collection, item: bpy.types.Object,
        icon: int, active_data: bpy.types.PropertyGroup, active_property: str, index: int = 0, flt_flag: int = 0,
    ) -> None:  # fmt: skip
        module = item.mphdrr_module
        row = layout.row(align=True)
        row.active = module.visible
        columns = row.row(align=True)
        columns.alert = bool(module.problem or module.finding) or not following.has_field_of_view(item)
        length = f"{module.collimator_length:.1f}" if pinholes.has_pinholes(kind_of(data)) else ""
        _draw_columns(columns, item.name, f"{module.pinhole_distance:.1f}", length)
        if columns.alert:
            columns.label(text="", icon="ERROR")
        row.prop(module, "visible", text="", icon="HIDE_OFF" if module.visible else "HIDE_ON", emboss=False)

    def draw_filter(self, context: bpy.types.Context, layout: bpy.types.UILayout) -> None:
        layout.prop(self, "filter_name", text="", icon="VIEWZOOM")

    def filter_items(
        self, context: bpy.types.Context, data: bpy.types.Collection, property: str
    ) -> tuple[list[int], list[int]]:
        items = getattr(data, property)
        text = self.filter_name.lower()
        flags = [self.bitflag_filter_item if o.mphdrr_module.is_module and text in o.name.lower() else 0 for o in items]
        by_number = sorted(range(len(items)), key=lambda i: (items[i].mphdrr_module.index, items[i].name))
        return flags, np.argsort(by_number).tolist()  # the new place of each item


class MPHDRR_PT_geometry(Folded, bpy.types.Panel):
    """Import a scanner, choose one of several, and show part of its modules."""

    bl_order = ids.ORDER_GEOMETRY

    poll = layouts.shown_where(lambda context: scanner.active_scanner(context.scene) is not None)

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(self.layout)
        collection = scanner.active_scanner(context.scene)
        if collection is None:  # the scene may have changed since poll
            return
        if len(scanner.scanners(context.scene)) > 1:
            layout.prop(context.scene.mphdrr_geometry, "scanner", text="")
        if not scanner.is_set_up(context.scene):
            box = layout.box().column(align=True)
            draw_text(box, "The scene's units are not millimetres")
            box.operator("mphdrr.set_up_scene", icon="SCENE_DATA")
        properties = collection.mphdrr_scanner
        n_rings = sum(c.mphdrr_scanner.is_ring for c in collection.children)
        workbook = bpy.path.basename(properties.workbook) or "none"
        modules = iface("{count} in {rings} rings" if n_rings > 1 else "{count} in a ring")
        modules = modules.format(count=properties.count, rings=n_rings)
        draw_facts(layout.split(factor=0.34), ("Workbook", workbook), ("Modules", modules))
        row, state = layout.split(factor=0.34), context.scene.mphdrr_geometry
        row.label(text="Visible")
        row.prop(state, "visible", text="", placeholder="All")
        draw_text(layout, state.visible_problem, "ERROR")
        row = layout.row(align=True)
        row.operator("mphdrr.import_geometry", text="Import Workbook")
        row.operator("mphdrr.add_xray_system")


class ScannerPanel(Folded):
    """Mixin of panels inside Geometry that need a scanner and draw it in `draw_scanner`."""

    bl_parent_id = "MPHDRR_PT_geometry"
    bl_order = 1  # after the panel of the modules

    poll = layouts.shown_where(lambda context: scanner.active_scanner(context.scene) is not None)

    def draw(self, context: bpy.types.Context) -> None:
        collection = scanner.active_scanner(context.scene)
        if collection is not None:  # the scene may have changed since poll
            self.draw_scanner(context, collection)

    def draw_scanner(self, context: bpy.types.Context, collection: bpy.types.Collection) -> None:
        """Draw the panel for the active scanner."""
        raise NotImplementedError


class MPHDRR_PT_modules(ScannerPanel, bpy.types.Panel):
    bl_order = 0

    def draw_scanner(self, context: bpy.types.Context, collection: bpy.types.Collection) -> None:
        layout = self.layout
        state = context.scene.mphdrr_geometry
        head = layout.row(align=True)
        head.active = False
        _draw_columns(head, "  Module", "b (mm)", "l (mm)" if pinholes.has_pinholes(kind_of(collection)) else "")
        head.label(text="", icon="BLANK1")
        head.separator(factor=2.0)  # above the list's scroll bar
        layout.template_list(
            "MPHDRR_UL_modules", "", collection, "all_objects", state, "active_index", rows=5, maxrows=5
        )

        if (camera := selection.listed_module(context.scene)) is not None:
            text = iface("Look Through {module}").format(module=camera.name)
            look = layout.operator("mphdrr.look_through_module", text=text, icon="OUTLINER_OB_CAMERA")
            look.number = camera.mphdrr_module.number
        row = layout.row(align=True)
        for name in ("show_rays", "show_frustums", "show_detectors"):
            row.prop(state, name, toggle=True)
        all_modules = row.row(align=True)
        all_modules.active = state.show_rays or state.show_frustums or state.show_detectors
        all_modules.prop(state, "sight_all", text="All", toggle=True)


def _draw_columns(layout: bpy.types.UILayout, name: str, *numbers: str) -> None:
    """Draw a row of the list of modules: a name and right-aligned numbers."""
    split = layout.split(factor=0.46, align=True)
    split.label(text=name)
    for text in numbers:
        cell = split.row()
        cell.alignment = "RIGHT"
        cell.label(text=text)
