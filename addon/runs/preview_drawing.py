"""The live preview's picture in the 3D views: in a corner, with its lines, and where the module's plane stands.

It is drawn over the views and is no datablock: nothing of it is saved, undone or rendered.
"""

import functools
from collections.abc import Callable
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from ...core.runs.letters import wrapped
from ..blender import windows

_WIDTH, _LEAST = 150.0, 60.0  # of the picture in the corner, and its least height, in Blender's units of its interface
_ABOVE, _BESIDE = 130.0, 50.0  # in such units: for the gizmos that turn the view, above the picture and beside it
_MARGIN, _TEXT = 20.0, 11.0
_BACK, _FRONT = (0.05, 0.05, 0.05, 0.75), (1.0, 1.0, 1.0, 1.0)
_TRIANGLES = ((0, 1, 2), (0, 2, 3))


def start(session: Any) -> Callable[[], None]:
    """Draw the preview of a `preview.Session` from now on; the result takes it back."""
    if bpy.app.background:
        return lambda: None
    view = bpy.types.SpaceView3D
    handles = [
        view.draw_handler_add(_draw_plane, (session,), "WINDOW", "POST_VIEW"),
        view.draw_handler_add(_draw_corner, (session,), "WINDOW", "POST_PIXEL"),
    ]

    def end() -> None:
        for handle in handles:
            view.draw_handler_remove(handle, "WINDOW")
        _textures.cache_clear()

    return end


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


def _draw_corner(session: Any) -> None:
    """Draw the picture and its lines in the lower right corner, beside the sidebar."""
    context = bpy.context
    unit = context.preferences.system.ui_scale
    margin, size = _MARGIN * unit, _TEXT * unit
    right = context.region.width - margin - _BESIDE * unit - _covered(context)
    blf.size(0, size)
    shown, width, height = session.shown, _WIDTH * unit, 0.0
    lines = [
        piece for line in session.lines for piece in wrapped(line, lambda text: blf.dimensions(0, text)[0] <= width)
    ]
    if shown is not None:
        rows, columns = shown.picture.shape[:2]
        free = context.region.height - _ABOVE * unit - 2 * margin - (1.4 * len(lines) + 2) * size
        aspect, most = columns / rows, max(free, _LEAST * unit)
        width, height = min(width, aspect * most), min(most, width / aspect)  # as large as fits
    left, top = right - max(width, _WIDTH * unit), margin + height + (1.4 * len(lines) + 2) * size
    gpu.state.blend_set("ALPHA")
    windows.draw_rectangle((left - size, margin - size, right + size, top), _BACK)
    if shown is not None:
        picture, colors = _textures(shown)
        _picture(picture, _box(left, margin + size, left + width, margin + size + height))
        _picture(colors, _box(left, margin, left + width, margin + 0.6 * size))
    blf.color(0, *_FRONT)
    for number, line in enumerate(lines):
        blf.position(0, left, top - (1.4 * number + 1.7) * size, 0)
        blf.draw(0, line)
    gpu.state.blend_set("NONE")


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
