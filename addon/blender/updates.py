"""What an edited property, or a room below, calls: functions by name, so that nobody imports what draws or rebuilds."""

from collections.abc import Callable
from typing import Any

import bpy

FUNCTIONS: dict[str, Callable[..., None]] = {}
"""Filled by `registration.py`. Those of properties take the property's object, collection or scene, and what was given to
`on_edit`.
"""


def on_edit(name: str, *arguments: Any) -> Callable[[bpy.types.PropertyGroup, bpy.types.Context], None]:
    """A property's ``update=``: calls ``FUNCTIONS[name](group.id_data, *arguments)``."""

    def edited(group: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
        FUNCTIONS[name](group.id_data, *arguments)

    return edited
