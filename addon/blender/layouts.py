"""How panels and dialogs show settings."""

from collections.abc import Callable, Iterable
from typing import Any

import bpy


def shown_where(is_met: Callable[[bpy.types.Context], Any]) -> Any:
    """The `poll` of a panel: in which contexts it is shown."""
    return classmethod(lambda panel, context: bool(is_met(context)))


def labelled(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """The layout, from now on with settings' names in a column of their own, and without the dots that animate them."""
    layout.use_property_split, layout.use_property_decorate = True, False
    return layout


def invoking(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """The layout, whose buttons from now on ask the user first where their operators do."""
    layout.operator_context = "INVOKE_DEFAULT"
    return layout


def draw_all(layout: bpy.types.UILayout, settings: Any, *names: str) -> None:
    """Draw settings below each other, as they are called."""
    for name in names:
        layout.prop(settings, name)


def draw_settings(
    layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, names: Iterable[tuple[str, bool]]
) -> None:
    """Draw settings, each with whether it has an effect; those without are greyed out.

    A number with a check mark, by `unset_name`, is shown only where the mark does not say that it is not given.
    """
    known = getattr(settings, "properties", settings).bl_rna.properties  # an operator keeps them apart
    for name, is_active in names:
        mark = unset_name(name)
        row = layout.row(heading=known[name].name if mark in known else "")
        row.active = is_active
        if mark in known:
            row.prop(settings, mark)
        if not getattr(settings, mark, False):
            row.prop(settings, name, **({"text": ""} if mark in known else {}))


def unset_name(name: str) -> str:
    """The check mark of a number: whether it is not given."""
    return f"{name}_unset"
