"""Phantoms follow their settings as these are edited: a sketch at once, the voxels when the edits rest.

A slider that is dragged changes a setting many times a second, and voxels take longer than that. So every change shows
a sketch, and once nothing has changed for a moment a thread makes the voxels, which take its place. Nothing reads a
sketch for voxels: who needs them early has them made at once (`settle`).

Voxels come after Blender has taken its undo step of the edit, so an undo or redo may bring a sketch back: then they are
made again. Where there is no window nothing runs beside a script, and small phantoms are made anew at once.
"""

from __future__ import annotations

import time
import traceback
from typing import Any

import bpy

from ..core.errors import InputError
from ..core.recording import recorded_warnings
from . import ids, jobs, phantoms

LIVE_VOXELS = 64**3
"""Up to so many voxels, of all its states, a phantom is made anew at once where there is no window."""

REFINED_VOXELS = 128**3
"""Up to so many a sketch becomes voxels by itself; more wait for Update Phantom."""

_REST = 0.3  # s without an edit
_INTERVAL = 0.1  # s between two looks
_PATIENCE = 10.0  # s that stopping waits for a thread


_refinement: tuple[str, jobs.Worker] | None = None  # the phantom's name, and what makes its voxels
_last_edit = 0.0  # by time.monotonic
_given_up: set[str] = set()  # names of phantoms whose voxels cannot be made, until they change


def settings_changed(item: Any, settings: Any) -> None:
    """A setting was edited: show what it does, and say of what cannot be made, or is not made by itself, that it is so."""
    if not isinstance(item, bpy.types.Object) or phantoms.settings_of(item) != settings:
        return  # an operator's, or on its way
    properties = getattr(item, ids.OBJECT_VOLUME)
    properties.outdated, properties.message = True, ""
    _cancel()
    _given_up.discard(item.name)
    with recorded_warnings() as caught:
        try:
            if _has_window() and not jobs.is_running():
                phantoms.sketch(item)
                _wait()
            else:
                make = phantoms.remaking(item)  # which finds what cannot be made
                if settings.n_voxels <= LIVE_VOXELS and not jobs.is_running():
                    phantoms.replace(item, make(None))
                else:
                    phantoms.update_outline(item)
        except InputError as error:
            properties.message = str(error)
            return
    properties.message = next(iter(caught), "")


def settle(item: bpy.types.Object) -> None:
    """Give a sketched phantom, or the one that a sketched volume belongs to, its voxels now.

    Raises
    ------
    InputError
        They are so many that this takes a job, or cannot be made.
    """
    phantom = phantoms.root_of(item)
    _cancel()
    if phantom is None or phantoms.settings_of(phantom).n_voxels > REFINED_VOXELS:
        raise InputError(f"{item.name!r} is a sketch of what its settings say: press Update Phantom first")
    phantoms.replace(phantom, phantoms.remaking(phantom)(None))


def is_coming(item: bpy.types.Object) -> bool:
    """Whether the voxels of a sketched phantom will be there by themselves."""
    properties = getattr(item, ids.OBJECT_VOLUME)
    settings = phantoms.settings_of(item)
    is_sketch = properties.sketched and settings is not None and item.library is None
    return is_sketch and settings.n_voxels <= REFINED_VOXELS and item.name not in _given_up


@bpy.app.handlers.persistent
def after_undo(*_: Any) -> None:
    """Undo, redo and loading may bring sketches."""
    _cancel()
    _given_up.clear()
    if _has_window() and any(is_coming(item) for item in bpy.data.objects):
        _wait()


@bpy.app.handlers.persistent
def before_load(*_: Any) -> None:
    """Nothing waits beyond its file."""
    stop()


def stop() -> None:
    """Forget what waits: before a file is loaded, or the extension is disabled."""
    running = _refinement
    _cancel()
    if running is not None and running[1].thread is not None:
        running[1].thread.join(_PATIENCE)
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)


def _has_window() -> bool:
    """Whether Blender's timers run."""
    return not bpy.app.background


def _wait() -> None:
    global _last_edit
    _last_edit = time.monotonic()
    if not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=_INTERVAL)


def _cancel() -> None:
    """What a thread is making now is done, or of other settings than those that count."""
    global _refinement
    if _refinement is not None:
        _refinement[1].cancel.set()
        _refinement = None


def _look() -> float | None:
    """Take what a thread has made, and start the next one."""
    global _refinement
    if time.monotonic() - _last_edit < _REST or jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return _INTERVAL
    if _refinement is not None:
        name, worker = _refinement
        if worker.alive:
            return _INTERVAL
        _cancel()
        _finish(name, worker)
        jobs.redraw_sidebars()
    item = next((o for o in bpy.data.objects if is_coming(o)), None)
    if item is None:
        return None
    try:
        worker = jobs.Worker("refining", phantoms.remaking(item))
    except InputError as error:
        _give_up(item, str(error))
        return _INTERVAL
    worker.start()
    _refinement = item.name, worker
    return _INTERVAL


def _finish(name: str, done: jobs.Worker) -> None:
    item = bpy.data.objects.get(name)
    if item is None or phantoms.settings_of(item) is None:
        return
    if done.result is not None and len(done.result) != len(phantoms.with_children(item)):
        return  # a volume of it has come or gone in the meantime: it is made once more
    try:
        if done.error is not None:
            raise done.error
        phantoms.replace(item, done.result or [])
        getattr(item, ids.OBJECT_VOLUME).message = next(iter(done.caught), "")
    except InputError as error:
        _give_up(item, str(error))
    except MemoryError:
        _give_up(item, "not enough memory; choose fewer voxels")
    except Exception as error:
        traceback.print_exception(error)
        _give_up(item, f"{type(error).__name__}: {error} (details in the console)")


def _give_up(item: bpy.types.Object, message: str) -> None:
    _given_up.add(item.name)
    getattr(item, ids.OBJECT_VOLUME).message = message
