"""Layouts of settings in panels and dialogs."""

from collections.abc import Callable, Iterable
from typing import Any

import bpy


def shown_where(is_met: Callable[[bpy.types.Context], Any]) -> Any:
    """Return the `poll` of a panel that is shown in the contexts where `is_met` is true."""
    return classmethod(lambda panel, context: bool(is_met(context)))


def labelled(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """Return the layout, set to show settings' names in a column of their own, without the dots that animate them."""
    layout.use_property_split, layout.use_property_decorate = True, False
    return layout


def invoking(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """Return the layout, set to let its buttons open the dialogs of their operators."""
    layout.operator_context = "INVOKE_DEFAULT"
    return layout


def draw_all(layout: bpy.types.UILayout, settings: Any, *names: str) -> None:
    """Draw settings below each other, under the names of their properties."""
    for name in names:
        layout.prop(settings, name)


def draw_settings(
    layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, names: Iterable[tuple[str, bool]]
) -> None:
    """Draw settings, given as (property name, whether it has an effect); those without effect are greyed out.

    A number with a check mark, called `unset_name`, is shown only where the mark is not set.
    """
    properties = getattr(settings, "properties", settings).bl_rna.properties  # an operator has its own in `properties`
    for name, is_active in names:
        mark_name = unset_name(name)
        row = layout.row(heading=properties[name].name if mark_name in properties else "")
        row.active = is_active
        if mark_name in properties:
            row.prop(settings, mark_name)
        if not getattr(settings, mark_name, False):
            row.prop(settings, name, **({"text": ""} if mark_name in properties else {}))


def unset_name(name: str) -> str:
    """Return the property name of a number's check mark, which is set where the number is left out."""
    return f"{name}_unset"
