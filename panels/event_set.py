"""Sidebar, Event Set: a recipe's events, tried on the phantom, made as a set, and opened in the scene."""

import bpy

from ..addon.blender import ids, layouts
from ..addon.events import event_notes
from ..addon.scanner import scanner
from .sidebar import Folded, draw_text


class MPHDRR_PT_event_set(Folded, bpy.types.Panel):
    bl_order = ids.ORDER_EVENTS

    poll = layouts.shown_where(lambda context: scanner.active_scanner(context.scene) or _is_chosen(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        settings = context.scene.mphdrr_events
        column = layout.column(align=True)
        column.prop(settings, "recipe", placeholder="None")
        column.operator_menu_enum("mphdrr.new_event_recipe", "like", text="New Recipe", icon="FILE_NEW")
        recipe_note, set_note = event_notes.recipe_note(settings.recipe), event_notes.set_note(settings.folder)
        if recipe_note is not None:
            _draw_note(layout, recipe_note)
        layout.prop(settings, "folder")
        if (note := recipe_note or set_note) is not None and not note.is_wrong:
            column = layout.column(align=True)
            _draw_number(column, settings, "number", "mphdrr.try_event", "Another One")
            _draw_number(column, settings, "count", "mphdrr.make_event_set", "Make Event Set")
        if settings.tried:
            draw_text(layout, settings.tried[:1].upper() + settings.tried[1:], "OUTLINER_DATA_VOLUME")
        if set_note is not None:
            _draw_note(layout, set_note)
            layout.prop(settings, "model", placeholder="First")
            _draw_number(layout, settings, "opened", "mphdrr.open_event", "Open Event")


def _is_chosen(scene: bpy.types.Scene) -> bool:
    """Return whether a recipe or a set is chosen, which needs no scanner in the scene."""
    return bool(scene.mphdrr_events.recipe or scene.mphdrr_events.folder)


def _draw_number(
    layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, number: str, operator: str, text: str
) -> None:
    """Draw the setting `number` and the button of the operator that uses it, side by side."""
    row = layout.row(align=True)
    row.use_property_split = False
    row.prop(settings, number)
    row.operator(operator, text=text)


def _draw_note(layout: bpy.types.UILayout, note: event_notes.Note) -> None:
    """Draw what is known of a recipe or a set, as an alert if something is wrong."""
    column = layout.column()
    column.alert = note.is_wrong
    draw_text(column, note.text, "ERROR" if note.is_wrong else "INFO")
