"""The live preview's picture in the 3D views: in a corner, with its lines, and where the module's plane stands.

It is drawn over the views and is no datablock: nothing of it is saved, undone or rendered.
"""

from collections.abc import Callable
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

_HEIGHT = 240.0  # of the picture in the corner, in Blender's units of its interface
_MARGIN, _TEXT = 12.0, 12.0
_BACK, _FRONT = (0.05, 0.05, 0.05, 0.75), (1.0, 1.0, 1.0, 1.0)
_TRIANGLES = ((0, 1, 2), (0, 2, 3))


def start(session: Any) -> Callable[[], None]:
    """Draw the preview of a `preview.Session` from now on; the result takes it back."""
    if bpy.app.background:
        return lambda: None
    view, textures = bpy.types.SpaceView3D, _Textures()
    handles = [
        view.draw_handler_add(_draw_plane, (session, textures), "WINDOW", "POST_VIEW"),
        view.draw_handler_add(_draw_corner, (session, textures), "WINDOW", "POST_PIXEL"),
    ]

    def end() -> None:
        for handle in handles:
            view.draw_handler_remove(handle, "WINDOW")

    return end


class _Textures:
    """The texture of the preview that is shown; made when it is first drawn."""

    def __init__(self) -> None:
        self._of: Any = None
        self._texture: Any = None

    def of(self, shown: Any) -> Any:
        """The texture of a preview's sheet."""
        if self._of is not shown:
            picture = shown.sheet.picture
            height, width = picture.shape[:2]
            pixels = np.ones((height, width, 4), np.float32)
            pixels[..., :3] = picture[::-1] / np.float32(255)
            data = gpu.types.Buffer("FLOAT", pixels.size, pixels.ravel())
            self._texture = gpu.types.GPUTexture((width, height), format="RGBA8", data=data)
            self._of = shown
        return self._texture


def _draw_corner(session: Any, textures: _Textures) -> None:
    """Draw the picture and its lines in the lower right corner, beside the sidebar."""
    context = bpy.context
    unit = context.preferences.system.ui_scale
    margin, size = _MARGIN * unit, _TEXT * unit
    right = context.region.width - margin - _covered(context)
    blf.size(0, size)
    lines, shown = session.lines, session.shown
    height = width = 0.0
    if shown is not None:
        rows, columns = shown.sheet.picture.shape[:2]
        height = min(_HEIGHT * unit, 0.5 * context.region.height)
        width = height * columns / rows
    lines = tuple(piece for line in lines for piece in _wrapped(line, max(width, 2 * _HEIGHT * unit)))
    box = max(width, *(blf.dimensions(0, line)[0] for line in lines)) + 2 * margin
    top = margin + height + (1.5 * len(lines) + 1) * size + margin
    left = right - box
    gpu.state.blend_set("ALPHA")
    _rectangle(left, margin, right, top)
    if shown is not None:
        x, y = left + margin, 2 * margin
        places = [(x, y + height), (x + width, y + height), (x + width, y), (x, y)]
        _picture(textures.of(shown), [(*place, 0.0) for place in places], (0.0, 1.0, 1.0, 0.0))
    blf.color(0, *_FRONT)
    for number, line in enumerate(lines):
        blf.position(0, left + margin, top - (1.5 * number + 2) * size, 0)
        blf.draw(0, line)
    gpu.state.blend_set("NONE")


def _draw_plane(session: Any, textures: _Textures) -> None:
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
    (row, column), (rows, columns) = shown.sheet.corners[0], shown.sheet.tile
    height, width = shown.sheet.picture.shape[:2]
    part = column / width, 1 - row / height, (column + columns) / width, 1 - (row + rows) / height
    gpu.state.depth_test_set("LESS_EQUAL")
    raised = corners + 1e-3 * inward  # before the plane of the last run
    _picture(textures.of(shown), raised.tolist(), part)
    gpu.state.depth_test_set("NONE")


def _picture(texture: Any, places: list[Any], part: tuple[float, float, float, float]) -> None:
    """Draw a part (left, top, right, bottom; 0 to 1 from the bottom left) of a texture to four places, clockwise."""
    left, top, right, bottom = part
    shader = gpu.shader.from_builtin("IMAGE")
    shader.uniform_sampler("image", texture)
    corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
    batch_for_shader(shader, "TRIS", {"pos": places, "texCoord": corners}, indices=_TRIANGLES).draw(shader)


def _rectangle(left: float, bottom: float, right: float, top: float) -> None:
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", _BACK)
    places = [(left, top), (right, top), (right, bottom), (left, bottom)]
    batch_for_shader(shader, "TRIS", {"pos": places}, indices=_TRIANGLES).draw(shader)


def _wrapped(line: str, width: float) -> list[str]:
    """A line as lines that are no wider than `width`, in pixels, where it has spaces."""
    pieces = [""]
    for word in line.split():
        longer = f"{pieces[-1]} {word}".strip()
        if pieces[-1] and blf.dimensions(0, longer)[0] > width:
            pieces.append(word)
        else:
            pieces[-1] = longer
    return pieces


def _covered(context: bpy.types.Context) -> float:
    """How much of the region's right the sidebar covers, in pixels."""
    if not context.preferences.system.use_region_overlap:
        return 0.0
    return float(
        max((region.width for region in context.area.regions if region.type == "UI" and region.width > 1), default=0)
    )
