"""Sidebar, Phantom: the active volume with its numbers, its look, its phantom's settings, and its view by a module."""

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon import recovery
from ..addon.blender import ids, layouts, storage
from ..addon.perspective import frustums
from ..addon.phantoms import phantom_properties, phantoms
from ..addon.scanner import scanner, selection
from ..addon.volumes import slices, volumes
from .sidebar import Folded, Popover, draw_facts, draw_text


class MPHDRR_PT_phantom(Folded, bpy.types.Panel):
    bl_label = ""  # `draw_header` says what the volume is
    bl_order = ids.ORDER_PHANTOM

    poll = layouts.shown_where(
        lambda context: scanner.active_scanner(context.scene) is not None or volumes.volume_objects(context.scene)
    )

    def draw_header(self, context: bpy.types.Context) -> None:
        item = volumes.panel_volume(context)
        is_phantom = item is None or phantoms.settings_of(item) is not None
        self.layout.label(text="Phantom" if is_phantom else "Volume")

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        top = layout.column()
        row = top.row(align=True)
        row.menu("MPHDRR_MT_add", text="Add Phantom", icon="OUTLINER_DATA_VOLUME")
        row.operator("mphdrr.import_volume", text="Import Volume", icon="IMPORT")
        if storage.missing_volumes():
            _draw_missing(top.column(align=True), context.scene)
        if (item := volumes.panel_volume(context)) is not None:
            _draw_numbers(layout, item)
            row = layout.split(factor=0.32, align=True)
            row.popover("MPHDRR_PT_phantom_settings")
            row = row.split(factor=0.38, align=True)
            row.popover("MPHDRR_PT_look")
            row.popover("MPHDRR_PT_perspective")
        elif volumes.volume_objects(context.scene):
            draw_text(layout, "Select a volume to see its numbers.", "INFO")


def _draw_missing(column: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """Draw the volumes whose files are gone: a button that makes phantoms again, and advice for other volumes."""
    remakeable, lost = recovery.missing_volumes(scene)
    column.alert = True
    column.label(text="Files of voxels are missing", icon="ERROR")
    if remakeable:
        text = iface("Make Again: {names}").format(names=", ".join(item.name for item in remakeable))
        column.operator("mphdrr.remake_volumes", text=text, icon="FILE_REFRESH")
    if lost:
        draw_text(column, recovery.advice(lost), "BLANK1")
    column.operator("mphdrr.find_volume_files", icon="VIEWZOOM")


def _draw_numbers(layout: bpy.types.UILayout, item: bpy.types.Object) -> None:
    """Draw the facts about a volume, and its message, if any."""
    settings = item.mphdrr_volume
    draw_facts(
        layout.split(factor=0.34),
        ("Volume", item.name),
        ("Voxels", " × ".join(map(str, settings.shape))),
        ("Size", " × ".join(f"{s:.3g}" for s in settings.spacing) + " mm"),
        ("Values", volumes.range_text(settings.minimum, settings.maximum, settings.unit)),
        *([("State", volumes.state_text(item))] if item.data.is_sequence else []),
        ("File", volumes.file_note(item)),
    )
    if settings.message:
        column = layout.column()
        column.alert = settings.outdated
        draw_text(column, settings.message, "ERROR" if settings.outdated else "INFO")
    if settings.outdated:
        _draw_update(layout, item)


class _VolumePanel(Popover):
    """Mixin of panels about the active volume (`volumes.panel_volume`), which draw it in `draw_volume`."""

    poll = layouts.shown_where(volumes.panel_volume)

    def draw(self, context: bpy.types.Context) -> None:
        layout, item = layouts.invoking(layouts.labelled(self.layout)), volumes.panel_volume(context)  # type: ignore[attr-defined]
        if item is not None:  # the scene may have changed since poll
            layout.context_pointer_set("object", item)  # the buttons work on this volume, active or not
            self.draw_volume(layout, context, item)

    def draw_volume(self, layout: bpy.types.UILayout, context: bpy.types.Context, item: bpy.types.Object) -> None:
        """Draw the panel for a volume."""
        raise NotImplementedError


class MPHDRR_PT_look(_VolumePanel, bpy.types.Panel):
    """Set how the volume is drawn, and add slices or a volume made from it."""

    def draw_volume(self, layout: bpy.types.UILayout, context: bpy.types.Context, item: bpy.types.Object) -> None:
        settings = item.mphdrr_volume
        if settings.quantity == "hu":
            layout.operator("mphdrr.ct_to_attenuation", icon="MOD_FLUIDSIM")
        if settings.quantity == "activity":
            layout.operator_menu_enum("mphdrr.add_dose_map", "isotope", text="Dose Map", icon="OUTLINER_DATA_VOLUME")
        column = layout.column(align=True)
        column.prop(settings, "display_low", text=iface("Low, {unit}").format(unit=settings.unit))
        column.prop(settings, "display_high", text=iface("High, {unit}").format(unit=settings.unit))
        looks = layout.grid_flow(columns=2, align=True)
        looks.use_property_split = False  # otherwise each name stands beside its button
        for name, *_ in phantom_properties.LOOKS[: None if settings.quantity in ("hu", "mu") else 4]:
            looks.prop_enum(settings, "look", name)
        if settings.look not in ("DENSITY", "BRIGHTEST"):
            layout.prop(settings, "surface", text=iface("Surface, {unit}").format(unit=settings.unit))
        if item.data.is_sequence:
            column = layout.column(align=True)
            column.prop(item.data, "frame_start", text="First Frame")
            column.prop(item.data, "sequence_mode", text="Then")
        if slices.planes_of(item):
            column = layout.column(align=True)
            for axis, name in enumerate(slices.plane_names(item)):
                column.prop(settings, "slices", index=axis, text=name)
            column.operator("mphdrr.remove_slices", icon="X")
        else:
            layout.operator("mphdrr.add_slices", icon="MESH_PLANE")


class MPHDRR_PT_phantom_settings(_VolumePanel, bpy.types.Panel):
    """Change the numbers from which the phantom is made."""

    bl_label = "Settings"

    poll = layouts.shown_where(lambda context: phantoms.settings_of(volumes.panel_volume(context)) is not None)

    def draw_volume(self, layout: bpy.types.UILayout, context: bpy.types.Context, item: bpy.types.Object) -> None:
        phantoms.settings_of(item).draw_settings(layout)
        column = layout.column(align=True)
        _draw_update(column, item)
        column.operator("mphdrr.apply_phantom_pose", icon="OBJECT_ORIGIN")
        has_outline = phantoms.outline_of(item) is not None
        text = "Hide Outline" if has_outline else "Show Outline"
        column.operator("mphdrr.show_phantom_outline", text=text, icon="SHADING_WIRE", depress=has_outline)


def _draw_update(layout: bpy.types.UILayout, item: bpy.types.Object) -> None:
    """Draw the button that makes a phantom again with its present settings."""
    row = layout.row(align=True)
    row.alert = item.mphdrr_volume.outdated
    row.context_pointer_set("object", item)
    text = "Changed: Update" if row.alert else "Update Phantom"
    row.operator("mphdrr.update_phantom", text=text, icon="FILE_REFRESH")


class MPHDRR_PT_perspective(_VolumePanel, bpy.types.Panel):
    """Show the volume in the coordinates of the active module: column, row and depth."""

    poll = layouts.shown_where(lambda context: selection.active_module(context) and volumes.panel_volume(context))

    def draw_volume(self, layout: bpy.types.UILayout, context: bpy.types.Context, item: bpy.types.Object) -> None:
        settings, camera = context.scene.mphdrr_perspective, selection.active_module(context)
        if camera is None:  # the scene may have changed since poll
            return
        text = iface("{volume}, by {module}").format(volume=item.name, module=camera.name)
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
    """Draw the volume and module of a frustum, and what has changed since it was made."""
    module = "?" if frustum.parent is None else frustum.parent.name
    text = iface("Shown: {volume}, by {module}").format(volume=frustums.volume_name(frustum), module=module)
    column.label(text=text, translate=False)
    if changed := frustums.changes(scene, frustum):
        column.alert = True
        draw_text(column, iface("Not as it is now: {text}").format(text=changed), "ERROR")
