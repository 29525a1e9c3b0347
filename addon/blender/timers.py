"""Functions that Blender calls in its main thread once it has time; without a window it never calls them."""

from collections.abc import Callable

import bpy

_TimerFunction = Callable[[], float | None]  # returns the seconds until its next call, or None for no further call
_scheduled: set[_TimerFunction] = set()


def schedule(function: _TimerFunction, seconds: float = 0.0) -> None:
    """Have a function called after some seconds, unless it is scheduled already."""
    _scheduled.add(function)
    if not bpy.app.timers.is_registered(function):
        bpy.app.timers.register(function, first_interval=seconds)


def cancel(function: _TimerFunction) -> None:
    """Cancel the call of a function that is scheduled."""
    if bpy.app.timers.is_registered(function):
        bpy.app.timers.unregister(function)


def stop() -> None:
    """Cancel all scheduled calls when the extension is disabled."""
    for function in _scheduled:
        cancel(function)
    _scheduled.clear()
