"""Sidebar, second step: the phantom, its numbers and looks; below it, the active volume as the active module sees it."""

from typing import Any

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon import recovery
from ..addon.blender import ids, jobs, layouts, storage
from ..addon.perspective import frustums
from ..addon.phantoms import phantom_properties, phantoms
from ..addon.scanner import selection
from ..addon.volumes import slices, volumes
from .sidebar import Folded, Sidebar, draw_facts, draw_hint, draw_text


class MPHDRR_PT_phantom(Sidebar, bpy.types.Panel):
    bl_order = ids.ORDER_PHANTOM

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        adding = layout.column()
        column = adding.column(align=True)
        column.menu("MPHDRR_MT_add", text="Add Phantom", icon="OUTLINER_DATA_VOLUME")
        column.operator("mphdrr.import_volume", text="Import Volume", icon="IMPORT")
        if storage.missing_volumes():
            _draw_missing(adding.column(align=True), context.scene)
        item = context.object
        if not volumes.is_volume(item):
            known = volumes.volume_objects(context.scene)
            draw_hint(layout, "Select a volume to see its numbers." if known else "No volume in the scene yet.")
            return
        _draw_numbers(layout, item)
        _draw_display(layout, item)
        phantom = phantoms.settings_of(item)
        if phantom is not None:
            _draw_phantom(layout, item, phantom)
        layout.operator("mphdrr.clean_volume_files", icon="TRASH")


def _draw_missing(column: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """The volumes whose files are gone: what can be made again, and what else to do."""
    again, others = recovery.missing(scene)
    column.alert = True
    column.label(text="Files of voxels are missing", icon="ERROR")
    if again:
        names = ", ".join(item.name for item in again)
        column.operator(
            "mphdrr.remake_volumes", text=iface("Make Again: {names}").format(names=names), icon="FILE_REFRESH"
        )
    if others:
        draw_text(column, recovery.what_to_do(others), "BLANK1")
    column.operator("mphdrr.find_volume_files", icon="VIEWZOOM")


def _draw_numbers(layout: bpy.types.UILayout, item: bpy.types.Object) -> None:
    settings = item.mphdrr_volume
    draw_facts(
        layout.split(factor=0.34),
        ("Volume", item.name),
        ("Holds", f"{settings.quantity}, {settings.unit}"),
        ("Voxels", " × ".join(map(str, settings.shape))),
        ("Size", " × ".join(f"{s:.3g}" for s in settings.spacing) + " mm"),
        ("Values", f"{settings.minimum:.4g} to {settings.maximum:.4g}"),
        *([("State", volumes.state_text(item))] if item.data.is_sequence else []),
        ("File", volumes.file_state(item)),
    )


def _draw_display(layout: bpy.types.UILayout, item: bpy.types.Object) -> None:
    settings = item.mphdrr_volume
    if settings.quantity == "hu":
        layout.operator("mphdrr.ct_to_attenuation", icon="MOD_FLUIDSIM")
    if settings.quantity == "activity":
        layout.operator_menu_enum("mphdrr.add_dose_map", "isotope", text="Dose Map", icon="OUTLINER_DATA_VOLUME")
    column = layout.column(align=True)
    column.prop(settings, "display_low", text=iface("Low, {unit}").format(unit=settings.unit))
    column.prop(settings, "display_high", text=iface("High, {unit}").format(unit=settings.unit))
    looks = layout.grid_flow(columns=2, align=True)
    looks.use_property_split = False  # or each name stands beside its button
    for name, *_ in phantom_properties.LOOKS[: None if settings.quantity == "hu" else 4]:
        looks.prop_enum(settings, "look", name)
    if settings.look not in ("DENSITY", "BRIGHTEST"):
        layout.prop(settings, "surface", text=iface("Surface, {unit}").format(unit=settings.unit))
    if item.data.is_sequence:
        column = layout.column(align=True)
        column.prop(item.data, "frame_start", text="First Frame")
        column.prop(item.data, "sequence_mode", text="Then")
    if slices.planes_of(item):
        column = layout.column(align=True)
        for axis, name in enumerate(slices.names(item)):
            column.prop(settings, "slices", index=axis, text=name)
        column.operator("mphdrr.remove_slices", icon="X")
    else:
        layout.operator("mphdrr.add_slices", icon="MESH_PLANE")


def _draw_phantom(layout: bpy.types.UILayout, item: bpy.types.Object, phantom: Any) -> None:
    """A phantom's settings, what is wrong with them, and what can be done to it."""
    settings = item.mphdrr_volume
    phantom.draw_settings(layout)
    if settings.message:
        column = layout.column()
        column.alert = settings.outdated
        draw_text(column, settings.message, "ERROR" if settings.outdated else "INFO")
    column = layout.column(align=True)
    row = column.row(align=True)
    row.alert = settings.outdated
    text = "Changed: Update" if settings.outdated else "Update Phantom"
    row.operator("mphdrr.update_phantom", text=text, icon="FILE_REFRESH")
    column.operator("mphdrr.apply_phantom_pose", icon="OBJECT_ORIGIN")
    shown = phantoms.outline_of(item) is not None
    text = "Hide Outline" if shown else "Show Outline"
    column.operator("mphdrr.show_phantom_outline", text=text, icon="SHADING_WIRE", depress=shown)


class MPHDRR_PT_perspective(Folded, bpy.types.Panel):
    bl_parent_id = "MPHDRR_PT_phantom"

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        settings, camera = context.scene.mphdrr_perspective, selection.active_module(context)
        if camera is None:
            draw_hint(layout, "Import a geometry first.")
            return
        jobs.draw_job(layout)
        name = context.object.name if volumes.is_volume(context.object) else iface("no volume is selected")
        text = iface("{volume}, by {module}").format(volume=name, module=camera.name)
        layout.label(text=text, translate=False, icon="VIEW_PERSPECTIVE")
        layouts.draw_all(layout.column(align=True), settings, "uniform", "planes")
        row = layout.row(align=True)
        row.operator("mphdrr.show_in_perspective")
        row.operator("mphdrr.clear_perspective", text="", icon="X")
        for frustum in frustums.frustums(context.scene):
            _draw_frustum(layout.column(align=True), context.scene, frustum)
        layout.prop(settings, "cells")
        layout.operator("mphdrr.resample_in_perspective")


def _draw_frustum(column: bpy.types.UILayout, scene: bpy.types.Scene, frustum: bpy.types.Object) -> None:
    """What is shown, and what has changed since."""
    module = "?" if frustum.parent is None else frustum.parent.name
    text = iface("Shown: {volume}, by {module}").format(volume=frustums.volume_of(frustum), module=module)
    column.label(text=text, translate=False)
    if changed := frustums.changes(scene, frustum):
        column.alert = True
        draw_text(column, iface("Not as it is now: {text}").format(text=changed), "ERROR")
