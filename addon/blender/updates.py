"""Functions, by name, that edited properties and lower rooms call, so that these need not import what draws or rebuilds."""

from collections.abc import Callable
from typing import Any

import bpy

FUNCTIONS: dict[str, Callable[..., None]] = {}
"""Functions by name, filled by `registration.py`.

A function that a property calls takes the property's object, collection or scene, and the arguments of `on_edit`.
"""


def on_edit(name: str, *arguments: Any) -> Callable[[bpy.types.PropertyGroup, bpy.types.Context], None]:
    """Return a property's ``update=`` function, which calls ``FUNCTIONS[name](group.id_data, *arguments)``."""

    def update(group: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
        """Call the registered function for an edited property."""
        FUNCTIONS[name](group.id_data, *arguments)

    return update
