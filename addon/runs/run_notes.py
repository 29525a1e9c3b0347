"""Lines over the pictures in the Image Editor: what was said of measured counts, and what has changed since."""

import blf
import bpy

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
    if not texts:
        return
    scale = context.preferences.system.ui_scale
    blf.size(0, _SIZE * scale)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 5, 0.0, 0.0, 0.0, 1.0)
    for k, (text, color) in enumerate(texts):
        blf.color(0, *color)
        blf.position(0, _LEFT * scale, (_BOTTOM + 1.5 * _SIZE * k) * scale, 0)
        blf.draw(0, text)
    blf.disable(0, blf.SHADOW)
