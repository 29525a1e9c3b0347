"""Picture of the live preview in the 3D views: in a box that can be dragged, and where the module's plane stands.

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

# Lengths in units of Blender's interface: width and smallest height of the picture; free space above and beside it for the
# gizmos that turn the view; margin of the box, and size of its letters.
_WIDTH, _MIN_HEIGHT = 150.0, 60.0
_ABOVE, _BESIDE = 130.0, 50.0
_MARGIN, _TEXT = 20.0, 11.0
_BACK, _FRONT = (0.05, 0.05, 0.05, 0.75), (1.0, 1.0, 1.0, 1.0)
_TRIANGLES = ((0, 1, 2), (0, 2, 3))

_Pair = tuple[float, float]
_boxes: dict[int, tuple[tuple[float, float, float, float], _Pair]] = {}
"""Box (left, bottom, right, top) and its range of motion to the right and up, pixels of the region, by 3D view."""


def start(session: Any) -> Callable[[], None]:
    """Draw the preview of a `preview.Session` from now on; return a function that ends the drawing."""
    if bpy.app.background:
        return lambda: None
    view = bpy.types.SpaceView3D
    handles = [
        view.draw_handler_add(_draw_plane, (session,), "WINDOW", "POST_VIEW"),
        view.draw_handler_add(_draw_box, (session,), "WINDOW", "POST_PIXEL"),
    ]

    def end() -> None:
        """Remove the drawing from the 3D views, and free its textures."""
        for handle in handles:
            view.draw_handler_remove(handle, "WINDOW")
        _textures.cache_clear()
        _boxes.clear()

    return end


def is_over(region: bpy.types.Region, x: float, y: float) -> bool:
    """Return whether a pixel of a 3D view is in the box."""
    (left, bottom, right, top), _ = _boxes.get(region.as_pointer(), ((0.0,) * 4, (0.0, 0.0)))
    return left <= x < right and bottom <= y < top


def outline(region: bpy.types.Region) -> None:
    """Draw a frame around the box while the mouse is over it."""
    left, bottom, right, top = _boxes[region.as_pointer()][0]
    frame = _box(left, bottom, right, top)
    windows.draw_lines([*frame, frame[0]], _FRONT, 1.0, "LINE_STRIP")


def drag(context: bpy.types.Context, start: _Pair, pixels: _Pair) -> None:
    """Move the box, which was at `start` (0 to 1 of its ranges), by so many pixels to the right and up."""
    range_ = _boxes[context.region.as_pointer()][1]
    position = [min(1.0, max(0.0, a + b / max(c, 1.0))) for a, b, c in zip(start, pixels, range_, strict=True)]
    context.scene.mphdrr_display.preview_place = position
    windows.redraw("VIEW_3D")


@functools.lru_cache(maxsize=1)
def _textures(preview: Any) -> tuple[Any, Any]:
    """Return the textures of a preview's picture and of its colour bar; they are made when they are first drawn."""
    return _texture(preview.picture), _texture(preview.colors)


def _texture(picture: NDArray[np.uint8]) -> Any:
    """Return the texture of a picture with row 0 at the top."""
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
    right = context.region.width - margin - _BESIDE * unit - _covered_width(context)
    preview, width, height = session.preview, _WIDTH * unit, 0.0

    def fits(text: str) -> bool:
        """Return whether a text is at most as wide as the box."""
        return windows.text_width(text, size) <= _WIDTH * unit

    lines = [piece for line in session.lines for piece in wrap_text(line, fits)]
    if preview is not None:
        rows, columns = preview.picture.shape[:2]
        free_height = context.region.height - _ABOVE * unit - 2 * margin - (1.4 * len(lines) + 2) * size
        aspect, max_height = columns / rows, max(free_height, _MIN_HEIGHT * unit)
        width, height = min(width, aspect * max_height), min(max_height, width / aspect)  # as large as fits
    wide, high = max(width, _WIDTH * unit), height + (1.4 * len(lines) + 2) * size
    range_ = max(0.0, right - wide - margin), max(0.0, context.region.height - 2 * margin - high)
    x, y = context.scene.mphdrr_display.preview_place
    left_edge, bottom = margin + x * range_[0], margin + y * range_[1]
    top = bottom + high
    box = left_edge - size, bottom - size, left_edge + wide + size, top
    _boxes[context.region.as_pointer()] = box, range_
    windows.draw_rectangle(box, _BACK)
    if preview is not None:
        picture, colors = _textures(preview)
        _draw_texture(picture, _box(left_edge, bottom + size, left_edge + width, bottom + size + height))
        _draw_texture(colors, _box(left_edge, bottom, left_edge + width, bottom + 0.6 * size))
    windows.draw_texts(((line, left_edge, top - (1.4 * k + 1.7) * size, _FRONT) for k, line in enumerate(lines)), size)


def _draw_plane(session: Any) -> None:
    """Draw the picture where the module's plane stands; it faces the ROI, as the planes do."""
    preview = session.preview
    if preview is None or preview.corners is None:
        return
    corners, view = preview.corners, bpy.context.region_data
    inward = preview.run.views.detector_centers[0] - preview.run.views.sources[0]
    camera_matrix = np.array(view.view_matrix.inverted())
    to_viewer = camera_matrix[:3, 3] - corners.mean(axis=0) if view.is_perspective else camera_matrix[:3, 2]
    if np.dot(to_viewer, inward) <= 0:
        return
    gpu.state.depth_test_set("LESS_EQUAL")
    _draw_texture(_textures(preview)[0], (corners + 1e-3 * inward).tolist())  # before the plane of the last run
    gpu.state.depth_test_set("NONE")


def _box(left: float, bottom: float, right: float, top: float) -> list[tuple[float, float, float]]:
    """Return the corners of a rectangle, clockwise from top left."""
    return [(left, top, 0.0), (right, top, 0.0), (right, bottom, 0.0), (left, bottom, 0.0)]


def _draw_texture(texture: Any, positions: list[Any]) -> None:
    """Draw a texture between four positions, clockwise from its top left corner."""
    shader = gpu.shader.from_builtin("IMAGE")
    shader.uniform_sampler("image", texture)
    corners = [(0, 1), (1, 1), (1, 0), (0, 0)]
    batch_for_shader(shader, "TRIS", {"pos": positions, "texCoord": corners}, indices=_TRIANGLES).draw(shader)


def _covered_width(context: bpy.types.Context) -> float:
    """Return the width, pixels, of the region's right part that the sidebar covers."""
    if not context.preferences.system.use_region_overlap:
        return 0.0
    widths = [region.width for region in context.area.regions if region.type == "UI" and region.width > 1]
    return float(max(widths, default=0))
