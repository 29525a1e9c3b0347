"""Notes of the Event Set panel on a recipe and a set, read by threads, so that no file keeps the window waiting."""

import contextlib
import functools
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core import InputError, events, recording
from ...core.events.folders import INDEX, RECIPE, SetFolder
from ...core.events.store import EVENTS, SHARDS, file_size
from ...core.memory import readable_size
from ..blender import reports, storage, timers, windows

_CHECK_INTERVAL = 0.1  # s between two checks of a reading thread
_STAMP_LIFETIME = 2.0  # s for which a file's date, once read, is used


@dataclass(frozen=True)
class Note:
    """A line about a recipe or a set, and the names of its models."""

    text: str
    is_wrong: bool = False
    models: tuple[str, ...] = ()


_Stamp = tuple[Any, ...]  # dates and sizes of files; a changed stamp lets a file be read again
_UNKNOWN: tuple[_Stamp | None, Note] = None, Note("Reading …")
_notes: dict[Path, tuple[_Stamp, Note]] = {}
_threads: dict[Path, threading.Thread] = {}


def recipe_note(filepath: str) -> Note | None:
    """Return a note on a recipe's content, or on its error; None where no file is given."""
    return _note(storage.absolute(filepath), _read_recipe) if filepath else None


def set_note(folder: str) -> Note | None:
    """Return a note on a set's content; None where there is no set yet."""
    if not folder or not (storage.absolute(folder) / RECIPE).is_file():
        return None
    return _note(storage.absolute(folder), _read_set)


def models(folder: str) -> tuple[str, ...]:
    """Return the names of the models of which a set's events have projections."""
    note = set_note(folder)
    return () if note is None else note.models


def stop() -> None:
    """Forget all notes when the extension is disabled."""
    _notes.clear()
    _threads.clear()


def _read_recipe(path: Path) -> Note:
    """Return a note on phantoms, models and voxels; raise `InputError` also where a file named in the recipe is missing."""
    recipe = events.read_recipe(path)
    for file_name in recipe.files:
        recipe.input(file_name)
    phantoms, image_models = ", ".join(phantom.name for phantom in recipe.phantoms), ", ".join(recipe.models)
    radon = "" if recipe.radon is None else "Radon " + ", ".join(map(str, recipe.radon.counts))
    shape, spacing = recipe.grid.shape, recipe.grid.spacing
    shape_text = f"{shape[0]}³" if len(set(shape)) == 1 else " × ".join(map(str, shape))
    edges = spacing[:1] if np.allclose(spacing, spacing[0]) else spacing  # of a voxel, mm
    spacing_text = " × ".join(f"{edge:.3g}" for edge in edges)
    names = [phantoms, *filter(None, (image_models, radon))]
    return Note(f"{'; '.join(names)}; {shape_text} voxels of {spacing_text} mm")


def _read_set(path: Path) -> Note:
    """Return a note on the number and the size of a set's events."""
    folder = SetFolder(path)
    locations, models = folder.store.locations(), tuple(folder.recipe.models)
    size = sum(map(file_size, locations.values()))
    return Note(f"{len(locations)} of {sum(map(len, folder.requested))} events, {readable_size(size)}", models=models)


def _note(path: Path, read: Callable[[Path], Note]) -> Note:
    """Return the note on a file or folder as it is now; in a window, the previous note while a thread reads the file."""
    stamp = _stamp(path)
    if bpy.app.background and _notes.get(path, _UNKNOWN)[0] != stamp:
        _read(path, stamp, read)
    old_stamp, note = _notes.get(path, _UNKNOWN)
    if old_stamp != stamp and path not in _threads:
        _threads[path] = threading.Thread(target=_read, args=(path, stamp, read), name="mphDRR: reading", daemon=True)
        _threads[path].start()
        timers.schedule(_check_threads, _CHECK_INTERVAL)
    return note


def _read(path: Path, stamp: _Stamp, read: Callable[[Path], Note]) -> None:
    """Read a file and store its note, which may be an error."""
    try:
        with recording.recorded_warnings():
            note = read(path)
    except InputError as error:
        note = Note(reports.in_window(error).removeprefix(f"{path}: "), is_wrong=True)
    except Exception as error:  # for example while the file is being written
        note = Note(f"{path.name}: cannot be read ({type(error).__name__}: {error})", is_wrong=True)
    _notes[path] = stamp, note


def _stamp(path: Path) -> _Stamp:
    """Return the stamp of a file or folder and its content; the disk is asked every two seconds at most."""
    now = time.monotonic()
    return _cached_stamp(path, now if bpy.app.background else now // _STAMP_LIFETIME)


@functools.lru_cache(maxsize=64)
def _cached_stamp(path: Path, interval: float) -> _Stamp:
    """Return the stamp of a file or folder, see `_stamp`.

    The number of the present two seconds, `interval`, makes the cache forget older stamps.
    """
    stamp = []
    for member_path in (path, path / RECIPE, path / INDEX, path / EVENTS, path / SHARDS):
        with contextlib.suppress(OSError):
            status = member_path.stat()
            stamp.append((status.st_mtime_ns, status.st_size))
    return tuple(stamp)


def _check_threads() -> float | None:
    """Have the sidebars drawn again when a thread has finished."""
    finished = [path for path, reader in _threads.items() if not reader.is_alive()]
    for path in finished:
        del _threads[path]
    if finished:
        windows.redraw_sidebars()
    return _CHECK_INTERVAL if _threads else None
