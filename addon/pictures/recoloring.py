"""The pictures of the shown run in other colours or another window, made while Blender's window stays alive.

Step by step, the main thread reads the exact numbers and fills the images; a thread colours them. The mosaic comes first:
where the display has been edited again by then, the newest one's mosaic is made next.
"""

import time
from collections.abc import Generator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..blender import ids, timers
from . import images, planes

_REST = 0.05  # s after an edit of the display until the pictures are made anew
_INTERVAL, _STEP = 0.02, 0.03  # s between turns of the main thread, after each of which it may draw, and of a turn
_asked = False  # for pictures of the display as it is now
_steps: Generator[None, None, None] | None = None


def display_changed(*_: Any) -> None:
    """Show the run in other colours or another window; where there is a window, soon and bit by bit."""
    global _asked
    _asked = True
    if bpy.app.background:
        for _step in recoloring():
            pass
    else:
        timers.schedule(_turn, _REST)


def check(*_: Any) -> None:
    """Make the pictures anew where they are not as the display says: Undo, or a file, may have them of different times."""
    scene = bpy.context.scene
    shown = (images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}).get("display")  # no earlier version's has it
    if shown is None or not images.is_of(scene) or scene.mphdrr_display.problem:
        return
    if shown != repr(scene.mphdrr_display.display()):
        display_changed()


def stop() -> None:
    """Forget what waits: the extension is disabled."""
    global _asked, _steps
    _asked, _steps = False, None


def recoloring() -> Generator[None, None, None]:
    """The steps that show what is asked for, until nothing is. Between them, anything may change."""
    global _asked
    numbers: dict[int, NDArray[np.float32]] = {}
    while _asked:
        _asked = False
        settings, mosaic = bpy.context.scene.mphdrr_display, bpy.data.images.get(ids.MOSAIC)
        if settings.problem or mosaic is None:  # one between the typing of the window's two ends
            return
        uid = mosaic.session_uid
        for is_mosaic_made in images.showing_again(settings.display(), numbers):
            yield
            mosaic = bpy.data.images.get(ids.MOSAIC)
            _asked |= mosaic is None or mosaic.session_uid != uid  # another run is shown
            if _asked and (is_mosaic_made or mosaic is None or mosaic.session_uid != uid):
                break
        else:
            planes.update(bpy.context.scene)  # the pictures' sizes may be others now


def _turn() -> float | None:
    """Do some steps; later the next."""
    global _steps
    _steps = _steps or recoloring()
    enough = time.perf_counter() + _STEP
    while time.perf_counter() < enough:
        try:
            next(_steps)
        except StopIteration:
            _steps = None
            return None
        except BaseException:
            _steps = None
            raise
    return _INTERVAL
