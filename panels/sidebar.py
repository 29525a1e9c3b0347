"""What panels share: where they are, and how they show numbers and texts."""

import textwrap

import bpy

from ..addon.blender import ids

_LINE = 32  # letters that fit into the sidebar at its usual width


class Sidebar:
    """Mixed into the panels of the extension's tab."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.CATEGORY


class Folded(Sidebar):
    """Mixed into panels that are closed to begin with: all but the next step."""

    bl_options = {"DEFAULT_CLOSED"}


class Popover(Sidebar):
    """Mixed into panels that a button opens: what few change."""

    bl_options = {"INSTANCED"}
    bl_ui_units_x = 13  # as wide as the sidebar: labels fit in it


class ImagesSidebar(Sidebar):
    """Mixed into panels of the Image Editor, beside the pictures."""

    bl_space_type = "IMAGE_EDITOR"


def draw_facts(split: bpy.types.UILayout, *facts: tuple[str, str]) -> None:
    """Draw names and their values, side by side."""
    names, values = split.column(align=True), split.column(align=True)
    for name, value in facts:
        names.label(text=name)
        values.label(text=value)


def draw_text(layout: bpy.types.UILayout, text: str, icon: str = "ERROR") -> None:
    """Draw a text in lines that fit into a narrow sidebar."""
    column = layout.column(align=True)
    for i, line in enumerate(textwrap.wrap(text, _LINE)):
        column.label(text=line, icon="BLANK1" if i else icon)
