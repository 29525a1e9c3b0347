"""The live preview's picture in the 3D views: in a box that can be dragged, and where the module's plane stands.

It is drawn over the views and is no datablock: nothing of it is saved, undone or rendered.
"""

import functools
from collections.abc import Callable
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from ...core.runs.letters import wrap_text
from ..blender import windows

_WIDTH, _LEAST = 150.0, 60.0  # of the picture in the box, and its least height, in Blender's units of its interface
_ABOVE, _BESIDE = 130.0, 50.0  # in such units: for the gizmos that turn the view, above the picture and beside it
_MARGIN, _TEXT = 20.0, 11.0
_BACK, _FRONT = (0.05, 0.05, 0.05, 0.75), (1.0, 1.0, 1.0, 1.0)
_TRIANGLES = ((0, 1, 2), (0, 2, 3))

_Pair = tuple[float, float]
_boxes: dict[int, tuple[tuple[float, float, float, float], _Pair]] = {}
"""By 3D view: left, bottom, right and top of the box, and how far it can go to the right and up, pixels of the region."""


def start(session: Any) -> Callable[[], None]:
    """Draw the preview of a `preview.Session` from now on; the result takes it back."""
    if bpy.app.background:
        return lambda: None
    view = bpy.types.SpaceView3D
    handles = [
        view.draw_handler_add(_draw_plane, (session,), "WINDOW", "POST_VIEW"),
        view.draw_handler_add(_draw_box, (session,), "WINDOW", "POST_PIXEL"),
    ]

    def end() -> None:
        for handle in handles:
            view.draw_handler_remove(handle, "WINDOW")
        _textures.cache_clear()
        _boxes.clear()

    return end


def is_over(region: bpy.types.Region, x: float, y: float) -> bool:
    """Whether a pixel of a 3D view is in the box."""
    (left, bottom, right, top), _ = _boxes.get(region.as_pointer(), ((0.0,) * 4, (0.0, 0.0)))
    return left <= x < right and bottom <= y < top


def outline(region: bpy.types.Region) -> None:
    """Frame the box, which the mouse is over."""
    left, bottom, right, top = _boxes[region.as_pointer()][0]
    frame = _box(left, bottom, right, top)
    windows.draw_lines([*frame, frame[0]], _FRONT, 1.0, "LINE_STRIP")


def drag(context: bpy.types.Context, start: _Pair, pixels: _Pair) -> None:
    """Put the box, which was at the `start` of its ways, so many pixels further to the right and up."""
    room = _boxes[context.region.as_pointer()][1]
    place = [min(1.0, max(0.0, a + b / max(c, 1.0))) for a, b, c in zip(start, pixels, room, strict=True)]
    context.scene.mphdrr_display.preview_place = place
    windows.redraw("VIEW_3D")


@functools.lru_cache(maxsize=1)
def _textures(shown: Any) -> tuple[Any, Any]:
    """The textures of a preview's picture and of its colours; made when they are first drawn."""
    return _texture(shown.picture), _texture(shown.colors)


def _texture(picture: NDArray[np.uint8]) -> Any:
    height, width = picture.shape[:2]
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = picture[::-1] / np.float32(255)
    data = gpu.types.Buffer("FLOAT", pixels.size, pixels.ravel())
    return gpu.types.GPUTexture((width, height), format="RGBA8", data=data)


def _draw_box(session: Any) -> None:
    """Draw the picture and its lines where the user has dragged them, at first lower right, beside the sidebar."""
    context = bpy.context
    unit = context.preferences.system.ui_scale
    margin, size = _MARGIN * unit, _TEXT * unit
    right = context.region.width - margin - _BESIDE * unit - _covered(context)
    shown, width, height = session.shown, _WIDTH * unit, 0.0

    def fits(text: str) -> bool:
        return windows.text_width(text, size) <= _WIDTH * unit

    lines = [piece for line in session.lines for piece in wrap_text(line, fits)]
    if shown is not None:
        rows, columns = shown.picture.shape[:2]
        free = context.region.height - _ABOVE * unit - 2 * margin - (1.4 * len(lines) + 2) * size
        aspect, most = columns / rows, max(free, _LEAST * unit)
        width, height = min(width, aspect * most), min(most, width / aspect)  # as large as fits
    wide, high = max(width, _WIDTH * unit), height + (1.4 * len(lines) + 2) * size
    room = max(0.0, right - wide - margin), max(0.0, context.region.height - 2 * margin - high)
    x, y = context.scene.mphdrr_display.preview_place
    left, bottom = margin + x * room[0], margin + y * room[1]
    top = bottom + high
    box = left - size, bottom - size, left + wide + size, top
    _boxes[context.region.as_pointer()] = box, room
    windows.draw_rectangle(box, _BACK)
    if shown is not None:
        picture, colors = _textures(shown)
        _picture(picture, _box(left, bottom + size, left + width, bottom + size + height))
        _picture(colors, _box(left, bottom, left + width, bottom + 0.6 * size))
    windows.draw_texts(((line, left, top - (1.4 * k + 1.7) * size, _FRONT) for k, line in enumerate(lines)), size)


def _draw_plane(session: Any) -> None:
    """Draw the picture where the module's plane stands; it faces the ROI, as the planes do."""
    shown = session.shown
    if shown is None or shown.corners is None:
        return
    corners, view = shown.corners, bpy.context.region_data
    inward = shown.run.views.detector_centers[0] - shown.run.views.sources[0]
    back = np.array(view.view_matrix.inverted())
    towards = back[:3, 3] - corners.mean(axis=0) if view.is_perspective else back[:3, 2]
    if np.dot(towards, inward) <= 0:
        return
    gpu.state.depth_test_set("LESS_EQUAL")
    _picture(_textures(shown)[0], (corners + 1e-3 * inward).tolist())  # before the plane of the last run
    gpu.state.depth_test_set("NONE")


def _box(left: float, bottom: float, right: float, top: float) -> list[tuple[float, float, float]]:
    return [(left, top, 0.0), (right, top, 0.0), (right, bottom, 0.0), (left, bottom, 0.0)]


def _picture(texture: Any, places: list[Any]) -> None:
    """Draw a texture to four places: from its top left, clockwise."""
    shader = gpu.shader.from_builtin("IMAGE")
    shader.uniform_sampler("image", texture)
    corners = [(0, 1), (1, 1), (1, 0), (0, 0)]
    batch_for_shader(shader, "TRIS", {"pos": places, "texCoord": corners}, indices=_TRIANGLES).draw(shader)


def _covered(context: bpy.types.Context) -> float:
    """How much of the region's right the sidebar covers, in pixels."""
    if not context.preferences.system.use_region_overlap:
        return 0.0
    return float(
        max((region.width for region in context.area.regions if region.type == "UI" and region.width > 1), default=0)
    )
