"""Functions that Blender calls once it has time, in its main thread; where there is no window, it does so never."""

from collections.abc import Callable

import bpy

_Function = Callable[[], float | None]  # returns the seconds until it is called again, or None
_known: set[_Function] = set()


def soon(function: _Function, seconds: float = 0.0) -> None:
    """Have a function called in so many seconds, unless it waits already."""
    _known.add(function)
    if not bpy.app.timers.is_registered(function):
        bpy.app.timers.register(function, first_interval=seconds)


def forget(function: _Function) -> None:
    """Do not have a function called, where it waits."""
    if bpy.app.timers.is_registered(function):
        bpy.app.timers.unregister(function)


def stop() -> None:
    """Forget all that wait: the extension is disabled."""
    for function in _known:
        forget(function)
    _known.clear()
