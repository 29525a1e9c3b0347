"""The editors in Blender's windows, to have them drawn again."""

from collections.abc import Iterator

import bpy


def areas(*types: str) -> Iterator[bpy.types.Area]:
    """The editors of some types, in all windows."""
    for window in bpy.context.window_manager.windows:
        yield from (area for area in window.screen.areas if area.type in types)


def redraw(*types: str) -> None:
    """Have the editors of some types drawn again."""
    for area in areas(*types):
        area.tag_redraw()


def redraw_sidebars() -> None:
    """Have the 3D views' sidebars drawn again, but not the scene, which would be slow."""
    for area in areas("VIEW_3D"):
        for region in area.regions:
            if region.type == "UI":
                region.tag_redraw()
