"""Sidebar, Geometry > Design: numbers and readouts (`following.py`) of the active module, and of all modules."""

import json
from collections.abc import Sequence

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender import ids, jobs
from ..addon.blender.layouts import invoking, labelled
from ..addon.properties import LABELS
from ..addon.scanner import following, scanner, selection
from .geometry import ScannerPanel
from .sidebar import draw_facts, draw_text

_MOST_FINDINGS = 8


class MPHDRR_PT_design(ScannerPanel, bpy.types.Panel):
    """The active module."""

    bl_label = "Design"

    def draw_scanner(self, context: bpy.types.Context, collection: bpy.types.Collection) -> None:
        layout = self.layout
        properties = collection.mphdrr_scanner
        if properties.untidy:
            box = layout.box().column(align=True)
            box.label(text=properties.untidy.capitalize(), icon="ERROR")
            box.operator(ids.TIDY_MODULES, icon="BRUSH_DATA")
        edited = sum(not following.shows_its_field(camera) for camera in scanner.modules(collection))
        if edited:
            box = layout.box().column(align=True)
            draw_text(
                box, f"Lens or sensor edited of {edited} camera{'s' * (edited > 1)}: not what the projections show"
            )
            box.operator(ids.RESET_CAMERAS, icon="CAMERA_DATA")
        camera = selection.active_module(context)
        if camera is None:
            layout.label(text="Select a module's camera", icon="INFO")
        else:
            _draw_module(layout, camera)
        row = invoking(layout.row(align=True))
        row.operator(ids.DUPLICATE_MODULES, text="Duplicate", icon="DUPLICATE")
        row.operator(ids.REMOVE_MODULES, text="Remove", icon="TRASH")
        row = layout.row(align=True)
        row.prop(properties, "keep_aimed", toggle=True, icon="CON_TRACKTO")
        row.operator(ids.AIM_MODULES)


class MPHDRR_PT_scanner_design(ScannerPanel, bpy.types.Panel):
    """All modules at once, checks and exports."""

    bl_label = "All Modules"

    def draw_scanner(self, context: bpy.types.Context, collection: bpy.types.Collection) -> None:
        layout = self.layout
        properties = collection.mphdrr_scanner
        column = _draw_numbers(layout, properties, properties.mixed.split())
        column.separator()
        column.prop(properties, "plate_thickness", text="Plate (mm)")
        column.prop(properties, "wall_thickness", text="Wall (mm)")
        column.prop(properties, "opening_angle")
        column.prop(properties, "edge_at")
        column.prop(properties, "intrinsic_fwhm", text="Crystal FWHM")
        draw_facts(
            layout.box().split(factor=0.42),
            ("Sensitivity", f"{properties.sensitivity:.1f} cps/MBq"),
            ("Mean FWHM", f"{properties.resolution:.2f} mm"),
            ("See the ROI", iface("{some} of {all} modules").format(some=properties.n_covering, all=properties.count)),
        )
        layout.operator_menu_enum(ids.RENUMBER_MODULES, "order", text="Renumber", icon="LINENUMBERS_ON")
        layout.operator(ids.CHECK_GEOMETRY, icon="CHECKMARK")
        if properties.findings:
            findings = json.loads(properties.findings)
            if not findings:
                layout.label(text="Nothing found", icon="CHECKMARK")
            for text in findings[:_MOST_FINDINGS]:
                draw_text(layout, text)
            if len(findings) > _MOST_FINDINGS:
                more = iface("... and {count} more").format(count=len(findings) - _MOST_FINDINGS)
                layout.label(text=more, icon="BLANK1")
        column = invoking(layout.column(align=True))
        column.operator_menu_enum(ids.ADD_MAP, "quantity", text="Add Map", icon="OUTLINER_DATA_VOLUME")
        jobs.draw_job(column)
        column = invoking(layout.column(align=True))
        column.operator(ids.EXPORT_GEOMETRY, text="Export Workbook", icon="EXPORT")
        column.operator(ids.EXPORT_FOR_PROGRAM, text="Export for a Program", icon="EXPORT")
        column.separator()
        column.operator(ids.REMOVE_SCANNER, icon="TRASH")


def _draw_module(layout: bpy.types.UILayout, camera: bpy.types.Object) -> None:
    module = camera.mphdrr_module
    layout.label(text=camera.name, icon="OUTLINER_OB_CAMERA")
    _draw_numbers(layout, module, mixed=())
    for text in (module.problem, module.finding, "" if module.aimed else "Not aimed at the isocentre"):
        if text:
            draw_text(layout, text)
    draw_facts(
        layout.box().split(factor=0.42),
        ("Distance b", f"{module.pinhole_distance:.2f} mm"),
        ("Sensitivity", f"{module.sensitivity:.2f} cps/MBq"),
        ("Resolution", f"{module.resolution:.2f} mm FWHM"),
        ("Magnif. l / b", f"{module.magnification:.3f}"),
        ("Radius seen", f"{module.roi_seen:.2f} mm"),
        ("ROI", "seen whole" if module.sees_roi else "not seen whole"),
    )


def _draw_numbers(
    layout: bpy.types.UILayout, numbers: bpy.types.PropertyGroup, mixed: Sequence[str]
) -> bpy.types.UILayout:
    """Draw d, Ld, Td, R and l; "mixed" stands beside those that differ between modules."""
    column = labelled(layout.column(align=True))
    for name, label in LABELS.items():
        if name != "collimator_length":
            column.prop(numbers, name, text=_label(label, name in mixed))
    column.row(align=True).prop(numbers, "length_mode", expand=True)
    row = column.row(align=True)
    row.enabled = numbers.length_mode == "TYPED"  # otherwise it follows the others
    row.prop(numbers, "collimator_length", text=_label(LABELS["collimator_length"], "collimator_length" in mixed))
    return column


def _label(text: str, is_mixed: bool) -> str:
    return iface("{name}, mixed" if is_mixed else "{name} (mm)").format(name=iface(text))
