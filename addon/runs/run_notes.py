"""Lines over the pictures in the Image Editor: what is known of measured counts, and what has changed since."""

import bpy

from ..blender import windows
from ..pictures import images
from . import runs

_COLOR = (1.0, 0.45, 0.35, 1.0)
_PLAIN = (1.0, 1.0, 1.0, 1.0)
_SIZE, _LEFT, _BOTTOM = 13, 12, 12  # of the letters, and from the region's corner; pixels at a resolution scale of 1


def draw() -> None:
    """Draw the line; Blender calls this for every Image Editor."""
    context = bpy.context
    if not images.is_ours(context.space_data.image):
        return
    lines = runs.change_lines(context.scene)
    if not images.is_of(context.scene):
        lines = ["the projections of another scene"]
    measured = runs.measured_text(context.scene)
    texts = [(measured, _PLAIN)] if measured else []
    if lines and lines != [runs.UNKNOWN]:
        texts.append((f"Not of the scene as it is now: {', '.join(lines)}", _COLOR))
    scale = context.preferences.system.ui_scale
    up = (scale * (_BOTTOM + 1.5 * _SIZE * k) for k in range(len(texts)))
    windows.draw_texts(
        ((text, scale * _LEFT, y, color) for (text, color), y in zip(texts, up, strict=True)), scale * _SIZE
    )
