"""Notes over the pictures in the Image Editor: measured counts in words, and changes of the scene since the run."""

import bpy

from ..blender import windows
from ..pictures import images, tiles
from . import runs

_COLOR = (1.0, 0.62, 0.2, 1.0)
_PLAIN, _BACK = (1.0, 1.0, 1.0, 1.0), (0.08, 0.08, 0.08, 1.0)
_SIZE, _LEFT = 13, 12  # height of the letters, and their distance from the left; pixels at a resolution scale of 1
_CORNER, _WIDTH = 0.3, 3.0  # length of a stale corner's sides relative to its tile, and their width, pixels as above


def draw() -> None:
    """Draw the notes on a bar below the pictures, and a corner at each stale tile.

    Blender calls this for every Image Editor.
    """
    context = bpy.context
    image = context.space_data.image
    if not images.is_ours(image):
        return
    lines, stale = runs.change_lines(context.scene), runs.stale_modules(context.scene)
    if not images.belong_to(context.scene):
        lines, stale = ["the projections of another scene"], None
    is_stale = stale != set()
    texts = [(f"Not of the scene as it is now: {', '.join(lines)}", _COLOR)] if is_stale else []
    if measured := runs.measured_text(context.scene):
        texts.append((measured, _PLAIN))
    if not texts:
        return
    scale = context.preferences.system.ui_scale
    bar, x, positioned = scale * images.BAR, scale * _LEFT, []
    windows.draw_rectangle((0.0, 0.0, context.region.width, bar), _BACK)
    for text, color in texts:
        positioned.append((text, x, 0.3 * bar, color))
        x += windows.text_width(text, scale * _SIZE) + 2 * scale * _LEFT
    windows.draw_texts(positioned, scale * _SIZE)
    for picture in tiles.shown_pictures(image):
        if stale is None or picture.number in stale:
            _draw_corner(tiles.frame(context, picture, image.size), scale)


def _draw_corner(frame: tuple[float, float, float, float], scale: float) -> None:
    """Draw the upper right corner of a frame from outside, so that nothing of the picture is covered."""
    _, bottom, right, top = frame
    side, half_width = _CORNER * (top - bottom), scale * _WIDTH / 2
    x, y = right + half_width, top + half_width
    windows.draw_lines([(x - side, y, 0), (x, y, 0), (x, y - side, 0)], _COLOR, scale * _WIDTH, "LINE_STRIP")
