"""Small plots in panels: Blender's icons of pixels that `core.figures` draws."""

from collections.abc import Callable, Sequence

import bpy.utils.previews
import numpy as np
from numpy.typing import NDArray

from ...core.figures.page import Page
from ...core.figures.reconstructions import LIGHTS, draw_objective

_PIXELS, _DOT = 256, 32
_PAPER, _INK, _CURVE = "#1d1d1d", "#8a8a8a", "#ff9a5c"

_icons: bpy.utils.previews.ImagePreviewCollection | None = None
_drawn: tuple[float, ...] = ()


def objective_icon(objective: Sequence[float]) -> int:
    """The number of an icon, for `template_icon`, that shows an objective by iteration."""
    global _drawn
    if _drawn != tuple(objective):
        forget()
        _drawn = tuple(objective)

    def drawn() -> NDArray[np.float32]:
        page = Page(_PIXELS, _PIXELS, _PAPER)
        draw_objective(page, objective, (8, 8, _PIXELS - 16, _PIXELS - 16), "", _CURVE, _INK, 3 * page.em)
        return np.concatenate([page.picture / np.float32(255), np.ones((_PIXELS, _PIXELS, 1), np.float32)], axis=2)

    return _icon("objective", drawn)


def dot_icon(light: str) -> int:
    """The number of an icon, a dot in one of the colours of `LIGHTS`."""

    def drawn() -> NDArray[np.float32]:
        across = np.arange(_DOT) - (_DOT - 1) / 2
        inside = np.clip(0.36 * _DOT - np.hypot(across, across[:, None]), 0.0, 1.0)
        color = np.array(list(bytes.fromhex(LIGHTS[light].removeprefix("#")))) / 255
        return np.concatenate([np.broadcast_to(color, (_DOT, _DOT, 3)), inside[..., None]], axis=2).astype(np.float32)

    return _icon(light, drawn)


def _icon(name: str, draw: Callable[[], NDArray[np.float32]]) -> int:
    """The number of an icon; ``draw()`` gives its pixels (height, width, 4), row 0 at the top, if it is new."""
    global _icons
    if _icons is None:
        _icons = bpy.utils.previews.new()
    if name not in _icons:
        pixels, shown = draw(), _icons.new(name)
        shown.image_size = (pixels.shape[1], pixels.shape[0])
        shown.image_pixels_float[:] = pixels[::-1].ravel().tolist()
    return int(_icons[name].icon_id)


def forget() -> None:
    """Draw anew next time."""
    if _icons is not None:
        _icons.clear()


def stop() -> None:
    """Remove the icons: the extension is disabled."""
    global _icons
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None
