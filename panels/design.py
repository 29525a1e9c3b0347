"""Sidebar, Geometry > Design: values and readouts (`addon/scanner/following.py`) of the active module or of all modules."""

import json
from collections.abc import Sequence

import bpy
import numpy as np
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import layouts
from ..addon.scanner import columns, following, module_values, pinholes, scanner, selection
from .geometry import ScannerPanel
from .sidebar import draw_facts, draw_text

_MAX_FINDINGS = 8  # number of findings that are shown
_ANY_POINT = np.ones((1, 3))  # mm; a point at which a module that can be aimed has a pose


class MPHDRR_PT_design(ScannerPanel, bpy.types.Panel):
    """Change the active module or all modules at once, check and export them."""

    def draw_scanner(self, context: bpy.types.Context, collection: bpy.types.Collection) -> None:
        layout = self.layout
        properties = collection.mphdrr_scanner
        if properties.untidy:
            box = layout.box().column(align=True)
            box.label(text=properties.untidy.capitalize(), icon="ERROR")
            box.operator("mphdrr.tidy_modules", icon="BRUSH_DATA")
        n_edited = sum(not following.has_field_of_view(camera) for camera in scanner.modules(collection))
        if n_edited:
            box = layout.box().column(align=True)
            cameras = f"{n_edited} camera{'s' * (n_edited > 1)}"
            draw_text(box, f"Lens or sensor of {cameras} edited: projections show something else")
            box.operator("mphdrr.reset_cameras", icon="CAMERA_DATA")
        camera, state = selection.active_module(context), context.scene.mphdrr_geometry
        row = layout.row(align=True)
        if camera is None and not state.all_at_once:
            row.label(text="Select a module", icon="INFO")
        else:
            row.label(text=(collection if state.all_at_once or camera is None else camera).name, translate=False)
        row.prop(state, "all_at_once", toggle=True)
        if state.all_at_once:
            _draw_all(layout, collection)
            return
        if camera is not None:
            _draw_module(layout, camera, module_values.kind_of(collection))
        row = layouts.invoking(layout.row(align=True))
        row.operator("mphdrr.duplicate_modules", text="Duplicate", icon="DUPLICATE")
        row.operator("mphdrr.remove_modules", text="Remove", icon="TRASH")
        if module_values.kind_of(collection).aimed(_ANY_POINT) is not None:
            row = layout.row(align=True)
            row.prop(properties, "keep_aimed", toggle=True, icon="CON_TRACKTO")
            row.operator("mphdrr.aim_modules")
        row = layouts.invoking(layout.row(align=True))
        row.operator("mphdrr.optimise", text="Optimise", icon="OPTIONS")
        row.operator("mphdrr.calibrate", icon="TRACKER")
        column = layout.column(align=True)
        for text in json.loads(properties.design or "[]") + json.loads(properties.calibration or "[]"):
            draw_text(column, text, icon="ERROR" if "not fit" in text else "DOT")


def _draw_all(layout: bpy.types.UILayout, collection: bpy.types.Collection) -> None:
    """Draw the values of all modules together, and the buttons that work on the whole scanner."""
    properties, kind = collection.mphdrr_scanner, module_values.kind_of(collection)
    column = _draw_values(layout, properties, kind, properties.mixed.split())
    if pinholes.has_pinholes(kind):
        _draw_pinholes(layout, column, properties)
    row = layout.row(align=True)
    row.operator_menu_enum("mphdrr.renumber_modules", "order", text="Renumber", icon="LINENUMBERS_ON")
    row.operator("mphdrr.check_geometry", text="Check", icon="CHECKMARK")
    if not pinholes.has_pinholes(kind):
        layout.prop(properties, "bore", text="Bore (mm)")
    if properties.findings:
        if not (findings := json.loads(properties.findings)):
            layout.label(text="Nothing found", icon="CHECKMARK")
        for text in findings[:_MAX_FINDINGS]:
            draw_text(layout, text)
        if len(findings) > _MAX_FINDINGS:
            text = iface("... and {count} more").format(count=len(findings) - _MAX_FINDINGS)
            layout.label(text=text, icon="BLANK1")
    column = layouts.invoking(layout.column(align=True))
    if pinholes.has_pinholes(kind):
        column.operator_menu_enum("mphdrr.add_map", "quantity", text="Add Map", icon="OUTLINER_DATA_VOLUME")
    row = column.row(align=True)
    row.operator("mphdrr.export_geometry", text="Export Workbook", icon="EXPORT")
    row.operator("mphdrr.remove_scanner", text="", icon="TRASH")
    column.operator("mphdrr.export_for_program", text="Export for a Program", icon="EXPORT")


def _draw_pinholes(layout: bpy.types.UILayout, column: bpy.types.UILayout, properties: bpy.types.PropertyGroup) -> None:
    """Draw the collimators' construction, and the readouts of all modules together."""
    column.separator()
    column.prop(properties, "plate_thickness", text="Plate (mm)")
    column.prop(properties, "wall_thickness", text="Wall (mm)")
    layouts.draw_all(column, properties, "opening_angle", "edge_at")
    column.prop(properties, "intrinsic_fwhm", text="Crystal FWHM")
    draw_facts(
        layout.box().split(factor=0.42),
        ("Sensitivity", f"{properties.sensitivity:.1f} cps/MBq"),
        ("Mean FWHM", f"{properties.resolution:.2f} mm"),
        ("See the ROI", iface("{some} of {all} modules").format(some=properties.n_covering, all=properties.count)),
    )


def _draw_module(layout: bpy.types.UILayout, camera: bpy.types.Object, kind: module_values.ScannerType) -> None:
    """Draw the values and readouts of one module, given by its camera."""
    module = camera.mphdrr_module
    _draw_values(layout, module, kind, mixed=())
    for text in (module.problem, module.finding):
        if text:
            draw_text(layout, text)
    if not module.aimed:
        draw_text(layout, "Not aimed at the isocentre", icon="INFO")
    facts = [("Distance b", f"{module.pinhole_distance:.2f} mm")]
    if pinholes.has_pinholes(kind):
        facts += [
            ("Sensitivity", f"{module.sensitivity:.2f} cps/MBq"),
            ("Resolution", f"{module.resolution:.2f} mm FWHM"),
            ("Magnif. l / b", f"{module.magnification:.3f}"),
            ("Sees the ROI", f"{'whole' if module.sees_roi else 'in part'}, to {module.roi_seen:.2f} mm"),
        ]
    draw_facts(layout.box().split(factor=0.42), *facts)


def _draw_values(
    layout: bpy.types.UILayout, values: bpy.types.PropertyGroup, kind: module_values.ScannerType, mixed: Sequence[str]
) -> bpy.types.UILayout:
    """Draw the values of the columns in the table of a kind of scanner, those with a formula last.

    `mixed` are the fields whose values differ from module to module, which the labels say. Returns the drawn column.
    """
    layout_column, with_formula = layouts.labelled(layout.column(align=True)), module_values.formula_columns(kind)
    for column in kind.columns.scalars.values():
        if column not in with_formula:
            layout_column.prop(values, column.field, text=_label(column, mixed))
    if with_formula:
        layout_column.row(align=True).prop(values, "length_mode", expand=True)
    for column in with_formula:
        row = layout_column.row(align=True)
        row.enabled = values.length_mode == "TYPED"  # otherwise the formula sets the value
        row.prop(values, column.field, text=_label(column, mixed))
    return layout_column


def _label(column: module_values.Column, mixed: Sequence[str]) -> str:
    """Return the label of a column's values, with the unit, or with "mixed" if its field is in `mixed`."""
    name = iface(columns.short_label(column))
    if column.field in mixed:
        return iface("{name}, mixed").format(name=name)
    return iface("{name} (mm)").format(name=name) if column.kind == "length" else name
