"""Views of the 3D editors on a scanner: the scanner, or its middle, beside the sidebar, and the former view after an undo.

Blender's undo leaves the views as they are, so the changes that an import made to them are stored here.
"""

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from mathutils import Quaternion, Vector

_SENSOR_SIZE = 72.0  # mm; a 3D view's lens maps it onto the longer side of the area
_CLIP_START, _CLIP_END = 1.0, 20.0  # nearest distance drawn, mm, and farthest one, in units of the scanner's radius

_DARK: dict[str, dict[str, Any]] = {
    "shading": {"background_type": "VIEWPORT", "background_color": (0.006, 0.007, 0.009)},
    "overlay": dict.fromkeys(
        ("show_floor", "show_axis_x", "show_axis_y", "show_cursor", "show_relationship_lines", "show_text"), False
    ),
}
"""Settings of a 3D view that show an example on a dark ground, without lines about it."""
_VIEW = "view_location", "view_rotation", "view_distance", "view_perspective"

_State = tuple[Any, ...]
_views_by_scanner: dict[str, dict[tuple[str, int, int], tuple[_State, _State]]] = {}
"""States of the views before and after a scanner was framed, by the scanner's name and the view's indices."""
_scanners_before_undo: set[str] = set()  # names


def frame_scanner(
    collection: bpy.types.Collection, reach: float, rotation: Quaternion | None = None, shown_reach: float = 0.0
) -> None:
    """Turn all 3D views, except those through a camera, to a scanner of radius `reach` mm around the isocentre.

    Seen from a `rotation`, it stands before a dark ground; a `shown_reach`, mm, shows only so much around the isocentre.
    """
    views = _views_by_scanner.setdefault(collection.name, {})
    for key, area, space in _spaces():
        old_state = _state(space)
        if key in views and old_state == views[key][1]:  # the user has not turned it since
            old_state = views[key][0]
        space.clip_start = max(space.clip_start, _CLIP_START)
        space.clip_end = max(space.clip_end, _CLIP_END * reach)
        view = space.region_3d
        if view is not None and view.view_perspective != "CAMERA":
            if rotation is not None:
                view.view_perspective, view.view_rotation = "PERSP", rotation
                for part, values in _DARK.items():
                    for name, value in values.items():
                        setattr(getattr(space, part), name, value)
            left_width, right_width = _covered_widths(area) if space == area.spaces.active else (0, 0)
            width, longer = max(area.width - left_width - right_width, 1), max(area.width, area.height, 1)
            radius = shown_reach or reach
            per_pixel = 2 * radius / min(width, max(area.height, 1))
            view.view_distance = float(np.hypot(per_pixel * longer * space.lens / _SENSOR_SIZE, radius))
            shift = view.view_distance * _SENSOR_SIZE / space.lens / longer * (right_width - left_width) / 2
            view.view_location = view.view_rotation @ Vector((shift, 0.0, 0.0))
        views[key] = old_state, _state(space)


def before_undo(*_: Any) -> None:
    """Store which scanners there are, to know which of them an undo or redo adds or removes."""
    _scanners_before_undo.clear()
    _scanners_before_undo.update(_scanners())


def after_undo(*_: Any) -> None:
    """Restore the views that framed a scanner whose import was undone or redone, unless the user has turned them."""
    changed = _scanners_before_undo ^ _scanners()
    for name in changed & _views_by_scanner.keys():
        for key, _, space in _spaces():
            if key not in _views_by_scanner[name]:
                continue
            current, restored = _views_by_scanner[name][key][:: -1 if name in _scanners_before_undo else 1]
            if _state(space) == current:
                for (owner, setting), value in zip(_settings(space), restored, strict=True):
                    setattr(owner, setting, value)


def forget(*_: Any) -> None:
    """Forget all views where another file is opened."""
    _views_by_scanner.clear()


def _scanners() -> set[str]:
    """Return the names of all scanners."""
    return {collection.name for collection in bpy.data.collections if collection.mphdrr_scanner.is_scanner}


def _spaces() -> Iterator[tuple[tuple[str, int, int], bpy.types.Area, bpy.types.SpaceView3D]]:
    """Yield all 3D views: indices of screen, area and space, then area and space."""
    for screen in bpy.data.screens:
        for i, area in enumerate(screen.areas):
            for j, space in enumerate(area.spaces):
                if space.type == "VIEW_3D":
                    yield (screen.name, i, j), area, space


def _state(space: bpy.types.SpaceView3D) -> _State:
    """Return the values of a view's settings that framing changes."""
    values = [getattr(owner, name) for owner, name in _settings(space)]
    return tuple(value if isinstance(value, str | float | int) else tuple(value) for value in values)


def _settings(space: bpy.types.SpaceView3D) -> list[tuple[Any, str]]:
    """Return owner and name of each setting of a view that framing changes: `_VIEW`'s only where it is drawn."""
    owners = {"clip_start": space, "clip_end": space} | {n: getattr(space, part) for part in _DARK for n in _DARK[part]}
    owners |= dict.fromkeys(_VIEW if space.region_3d else (), space.region_3d)
    return [(owner, name) for name, owner in owners.items()]


def _covered_widths(area: bpy.types.Area) -> tuple[int, int]:
    """Return the widths, pixels, that toolbar and sidebar cover at the left and the right of an area."""
    regions = [region for region in area.regions if region.type in ("UI", "TOOLS") and region.width > 1]  # 1: hidden
    widths = {region.alignment: region.width for region in regions}
    return widths.get("LEFT", 0), widths.get("RIGHT", 0)
