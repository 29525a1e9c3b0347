"""Small plots in panels: icons for Blender with pixels that `core.figures` draws."""

from collections.abc import Sequence

import bpy.utils.previews
import numpy as np

from ...core.figures.page import Page
from ...core.figures.reconstructions import draw_objective

_PIXELS = 256
_PAPER, _INK, _CURVE = "#1d1d1d", "#8a8a8a", "#ff9a5c"

_icons: bpy.utils.previews.ImagePreviewCollection | None = None
_drawn_objective: tuple[float, ...] = ()


def objective_icon(objective: Sequence[float]) -> int:
    """Return the number of an icon, for `template_icon`, that plots the objective by iteration."""
    global _icons, _drawn_objective
    if _icons is None:
        _icons = bpy.utils.previews.new()
    if _drawn_objective != tuple(objective) or "objective" not in _icons:
        _icons.clear()
        page = Page(_PIXELS, _PIXELS, _PAPER)
        draw_objective(page, objective, (8, 8, _PIXELS - 16, _PIXELS - 16), "", _CURVE, _INK, 3 * page.em)
        icon = _icons.new("objective")
        icon.image_size = (_PIXELS, _PIXELS)
        opaque = np.ones((_PIXELS, _PIXELS, 1), np.float32)
        colors = np.concatenate([page.picture[::-1] / np.float32(255), opaque], axis=2)
        icon.image_pixels_float[:] = colors.ravel().tolist()
        _drawn_objective = tuple(objective)
    return int(_icons["objective"].icon_id)


def stop() -> None:
    """Remove the icons when the extension is disabled."""
    global _icons
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None
