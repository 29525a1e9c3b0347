"""Recolouring of the shown run's pictures after an edit of the display, made while Blender's window stays alive.

Step by step, the main thread reads the exact numbers and fills the images; a worker thread colours them. The mosaic comes
first: if the display has been edited again by then, the mosaic is made next with the newest display.
"""

import time
from collections.abc import Generator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..blender import ids, timers
from . import images, planes

_PAUSE = 0.05  # s from an edit of the display until the pictures are recoloured
_INTERVAL, _TURN_TIME = 0.02, 0.03  # s between turns of the main thread, when it may draw, and length of a turn
_is_requested = False  # whether pictures with the present display are requested
_steps: Generator[None, None, None] | None = None


def display_changed(*_: Any) -> None:
    """Recolour the pictures after an edit of the display; with a window, after a short pause and bit by bit."""
    global _is_requested
    _is_requested = True
    if bpy.app.background:
        for _step in recoloring():
            pass
    else:
        timers.schedule(_take_turn, _PAUSE)


def check(*_: Any) -> None:
    """Recolour the pictures if they do not match the display: Undo, or a file, may have restored only some of them."""
    scene = bpy.context.scene
    drawn = (images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}).get("display")  # absent in older files
    if drawn is None or not images.belong_to(scene) or scene.mphdrr_display.problem:
        return
    if drawn != repr(scene.mphdrr_display.display()):
        display_changed()


def stop() -> None:
    """Forget the request and the steps when the extension is disabled."""
    global _is_requested, _steps
    _is_requested, _steps = False, None


def recoloring() -> Generator[None, None, None]:
    """Yield the steps that recolour the pictures until no request is left; anything may change between steps."""
    global _is_requested
    numbers: dict[int, NDArray[np.float32]] = {}
    while _is_requested:
        _is_requested = False
        settings, mosaic = bpy.context.scene.mphdrr_display, bpy.data.images.get(ids.MOSAIC)
        if settings.problem or mosaic is None:  # the window is invalid while its second end is not typed yet
            return
        uid = mosaic.session_uid
        for is_mosaic_made in images.recolor_images(settings.display(), numbers):
            yield
            mosaic = bpy.data.images.get(ids.MOSAIC)
            _is_requested |= mosaic is None or mosaic.session_uid != uid  # another run may be shown
            if _is_requested and (is_mosaic_made or mosaic is None or mosaic.session_uid != uid):
                break
        else:
            planes.update(bpy.context.scene)  # the pictures' sizes may have changed


def _take_turn() -> float | None:
    """Do some steps; return the seconds until the next turn, None when done."""
    global _steps
    steps, _steps = _steps or recoloring(), None  # None, too, where a step fails
    deadline = time.perf_counter() + _TURN_TIME
    for _step in steps:
        if time.perf_counter() >= deadline:
            _steps = steps
            return _INTERVAL
    return None
