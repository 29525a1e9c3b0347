"""Redrawing of the editors in Blender's windows, and lines and texts drawn over them."""

from collections.abc import Iterable, Iterator
from typing import Any

import blf
import bpy
import gpu
from gpu_extras.batch import batch_for_shader


def has_window() -> bool:
    """Return whether Blender has a window: without one, no timer runs and nothing is drawn."""
    return not bpy.app.background


def areas(*types: str) -> Iterator[bpy.types.Area]:
    """Yield the editors of the given types in all windows."""
    for window in bpy.context.window_manager.windows:
        yield from (area for area in window.screen.areas if area.type in types)


def redraw(*types: str) -> None:
    """Have the editors of the given types drawn again."""
    for area in areas(*types):
        area.tag_redraw()


def redraw_sidebars() -> None:
    """Have the 3D views' sidebars drawn again, but not the scene, which would be slow."""
    for area in areas("VIEW_3D"):
        for region in area.regions:
            if region.type == "UI":
                region.tag_redraw()


def draw_texts(texts: Iterable[tuple[str, float, float, tuple[float, ...]]], size: float) -> None:
    """Write texts (text, x, y, colour) with shadows over a region; positions and font size in pixels."""
    blf.size(0, size)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 5, 0.0, 0.0, 0.0, 1.0)
    for text, x, y, color in texts:
        blf.color(0, *color)
        blf.position(0, x, y, 0.0)
        blf.draw(0, text)
    blf.disable(0, blf.SHADOW)


def text_width(text: str, size: float) -> float:
    """Return the width, pixels, of a text that `draw_texts` writes."""
    blf.size(0, size)
    return float(blf.dimensions(0, text)[0])


def draw_rectangle(frame: tuple[float, float, float, float], color: tuple[float, ...]) -> None:
    """Fill a rectangle (left, bottom, right, top), pixels of the region."""
    left, bottom, right, top = frame
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", color)
    corners = [(left, bottom, 0.0), (right, bottom, 0.0), (left, top, 0.0), (right, top, 0.0)]
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRI_STRIP", {"pos": corners}).draw(shader)
    gpu.state.blend_set("NONE")


def draw_lines(points: Any, color: tuple[float, ...], width: float, kind: str = "LINES") -> None:
    """Draw lines `width` pixels wide through points (N, 3): a line per two points for "LINES", one line for "LINE_STRIP"."""
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", width)
    shader.uniform_float("color", color)
    batch_for_shader(shader, kind, {"pos": points}).draw(shader)
