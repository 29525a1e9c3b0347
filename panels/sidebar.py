"""Base classes of the panels by their place in the window, and functions that draw facts and texts."""

import textwrap

import bpy

from ..addon.blender import ids

_LINE_LENGTH = 32  # number of letters that fit into the sidebar at its usual width


class Sidebar:
    """Mixin of the panels in the extension's tab of the 3D view's sidebar."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = ids.CATEGORY


class Folded(Sidebar):
    """Mixin of sidebar panels that are closed at first: all but the next step."""

    bl_options = {"DEFAULT_CLOSED"}


class Popover(Sidebar):
    """Mixin of panels that a button opens, with settings that are rarely changed."""

    bl_options = {"INSTANCED"}
    bl_ui_units_x = 13  # the sidebar's width, into which labels fit


class ImagesSidebar(Sidebar):
    """Mixin of panels in the Image Editor's sidebar, beside the pictures."""

    bl_space_type = "IMAGE_EDITOR"


def draw_facts(split: bpy.types.UILayout, *facts: tuple[str, str]) -> None:
    """Draw names and values side by side, in the two columns of `split`."""
    names, values = split.column(align=True), split.column(align=True)
    for name, value in facts:
        names.label(text=name)
        values.label(text=value)


def draw_text(layout: bpy.types.UILayout, text: str, icon: str = "ERROR") -> None:
    """Draw a text in lines that fit into a narrow sidebar, with an icon before the first one."""
    column = layout.column(align=True)
    for i, line in enumerate(textwrap.wrap(text, _LINE_LENGTH)):
        column.label(text=line, icon="BLANK1" if i else icon)
