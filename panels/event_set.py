"""Sidebar, after the reconstruction: events of a recipe, tried on the phantom, made as a set, opened in the scene."""

import bpy

from ..addon.blender import ids, layouts
from ..addon.events import event_notes
from ..addon.scanner import scanner
from .sidebar import Folded, draw_hint, draw_text


class MPHDRR_PT_event_set(Folded, bpy.types.Panel):
    bl_order = ids.ORDER_EVENTS

    poll = layouts.shown_where(lambda context: scanner.active_scanner(context.scene) or _is_chosen(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        layout = layouts.invoking(layouts.labelled(self.layout))
        settings = context.scene.mphdrr_events
        column = layout.column(align=True)
        column.prop(settings, "recipe")
        column.operator_menu_enum("mphdrr.new_event_recipe", "like", text="New Recipe", icon="FILE_NEW")
        recipe, made = event_notes.of_recipe(settings.recipe), event_notes.of_set(settings.folder)
        if recipe is not None:
            _draw_note(layout, recipe)
        elif made is None:
            draw_hint(layout, "Choose a recipe, or write one.")
        if not (recipe or made or event_notes.NOTHING).is_wrong:
            column = layout.column(align=True)
            column.prop(settings, "number")
            column.operator("mphdrr.try_event", text="Another One", icon="FILE_REFRESH")
        if settings.tried:
            draw_text(layout, settings.tried[:1].upper() + settings.tried[1:], "OUTLINER_DATA_VOLUME")
        column = layout.column(align=True)
        layouts.draw_all(column, settings, "folder", "count")
        column.operator("mphdrr.make_event_set", icon="FILE_CACHE")
        if made is not None:
            _draw_note(layout, made)
            column = layout.column(align=True)
            column.prop(settings, "opened")
            column.prop(settings, "model", placeholder="First")
            column.operator("mphdrr.open_event", icon="OUTLINER_OB_VOLUME")


def _is_chosen(scene: bpy.types.Scene) -> bool:
    """Whether there is a recipe or a set, which need no scanner in the scene."""
    return bool(scene.mphdrr_events.recipe or scene.mphdrr_events.folder)


def _draw_note(layout: bpy.types.UILayout, note: event_notes.Note) -> None:
    column = layout.column()
    column.alert = note.is_wrong
    draw_text(column, note.text, "ERROR" if note.is_wrong else "INFO")
