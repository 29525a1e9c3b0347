"""How the 3D views look at a scanner: all of it beside the sidebar; and as before, once its import is undone.

Blender's undo leaves the views as they are, so what an import did to them is remembered here.
"""

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from mathutils import Quaternion, Vector

_SENSOR = 72.0  # mm: what a 3D view's lens maps onto the longer side of its area
_CLIP_START, _CLIP_END = 1.0, 20.0  # mm, and of the scanner's reach

_State = tuple[Any, ...]
_looked: dict[str, dict[tuple[str, int, int], tuple[_State, _State]]] = {}
"""By the name of a scanner, and the place of a view among screens, areas and spaces: the view before and after."""
_there: set[str] = set()  # the scanners before an undo


def look(collection: bpy.types.Collection, reach: float, rotation: Quaternion | None = None) -> None:
    """Turn all 3D views, but those through a camera, to a scanner of radius `reach` mm around the isocentre."""
    views = _looked.setdefault(collection.name, {})
    for key, area, space in _spaces():
        before = _state(space)
        if key in views and before == views[key][1]:  # nobody has turned it since the last look
            before = views[key][0]
        space.clip_start = max(space.clip_start, _CLIP_START)
        space.clip_end = max(space.clip_end, _CLIP_END * reach)
        view = space.region_3d
        if view is not None and view.view_perspective != "CAMERA":
            if rotation is not None:
                view.view_perspective, view.view_rotation = "PERSP", rotation
            left, right = _covered(area) if space == area.spaces.active else (0, 0)
            width, longer = max(area.width - left - right, 1), max(area.width, area.height, 1)
            per_pixel = 2 * reach / min(width, max(area.height, 1))
            view.view_distance = float(np.hypot(per_pixel * longer * space.lens / _SENSOR, reach))
            shift = view.view_distance * _SENSOR / space.lens / longer * (right - left) / 2
            view.view_location = view.view_rotation @ Vector((shift, 0.0, 0.0))
        views[key] = before, _state(space)


def before_undo(*_: Any) -> None:
    """Note which scanners there are, to know which of them an undo or redo brings or takes."""
    _there.clear()
    _there.update(_scanners())


def after_undo(*_: Any) -> None:
    """A view that nobody has turned since is as it was before, or after, an import that was undone or redone."""
    changed = _there ^ _scanners()
    for name in changed & _looked.keys():
        for key, _, space in _spaces():
            if key not in _looked[name]:
                continue
            now, then = _looked[name][key][:: -1 if name in _there else 1]
            if _state(space) == now:
                space.clip_start, space.clip_end, *turned = then
                if turned:
                    view = space.region_3d
                    view.view_location, view.view_rotation, view.view_distance, view.view_perspective = turned


def forget(*_: Any) -> None:
    """Another file is opened: its views are its own."""
    _looked.clear()


def _scanners() -> set[str]:
    return {collection.name for collection in bpy.data.collections if collection.mphdrr_scanner.is_scanner}


def _spaces() -> Iterator[tuple[tuple[str, int, int], bpy.types.Area, bpy.types.SpaceView3D]]:
    """All 3D views, with where they are."""
    for screen in bpy.data.screens:
        for i, area in enumerate(screen.areas):
            for j, space in enumerate(area.spaces):
                if space.type == "VIEW_3D":
                    yield (screen.name, i, j), area, space


def _state(space: bpy.types.SpaceView3D) -> _State:
    view = space.region_3d
    if view is None:
        return space.clip_start, space.clip_end
    turned = tuple(view.view_location), tuple(view.view_rotation), view.view_distance, view.view_perspective
    return space.clip_start, space.clip_end, *turned


def _covered(area: bpy.types.Area) -> tuple[int, int]:
    """Pixels of an area that its toolbar, and its sidebar, cover."""
    widths = {region.alignment: region.width for region in area.regions if region.type in ("UI", "TOOLS")}
    left, right = widths.get("LEFT", 0), widths.get("RIGHT", 0)
    return (left if left > 1 else 0), (right if right > 1 else 0)  # hidden ones are 1 wide
