"""What the Event Set panel says of a recipe and of a set: read by threads, so that no file keeps the window waiting."""

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

_INTERVAL = 0.1  # s between two looks at a thread that reads
_LOOK = 2.0  # s between two looks at a file's date


@dataclass(frozen=True)
class Note:
    """One line about a recipe or a set, and the names of its models."""

    text: str
    is_wrong: bool = False
    models: tuple[str, ...] = ()


_Stamp = tuple[Any, ...]  # by which a file that has changed is read again
_UNKNOWN: tuple[_Stamp | None, Note] = None, Note("Reading …")
_known: dict[Path, tuple[_Stamp, Note]] = {}
_readers: dict[Path, threading.Thread] = {}


def of_recipe(filepath: str) -> Note | None:
    """What a recipe is, or what is wrong with it; None where no file is given."""
    return _note(storage.absolute(filepath), _recipe_note) if filepath else None


def of_set(folder: str) -> Note | None:
    """What is in a set's folder; None where there is no set yet."""
    if not folder or not (storage.absolute(folder) / RECIPE).is_file():
        return None
    return _note(storage.absolute(folder), _set_note)


def models(folder: str) -> tuple[str, ...]:
    """Names of the models that a set's events have projections of."""
    note = of_set(folder)
    return () if note is None else note.models


def stop() -> None:
    """Forget everything: the extension is disabled."""
    _known.clear()
    _readers.clear()


def _recipe_note(path: Path) -> Note:
    """Phantoms, models and voxels; `InputError` also where a file that the recipe names is missing."""
    recipe = events.read_recipe(path)
    for name in recipe.files:
        recipe.input(name)
    names = [", ".join(entry.name for entry in recipe.phantoms), *([", ".join(recipe.models)] if recipe.models else [])]
    if recipe.radon is not None:
        names.append("Radon " + ", ".join(map(str, recipe.radon.counts)))
    shape, spacing = recipe.grid.shape, recipe.grid.spacing
    voxels = f"{shape[0]}³" if len(set(shape)) == 1 else " × ".join(map(str, shape))
    sides = f"{spacing[0]:.3g}" if np.allclose(spacing, spacing[0]) else " × ".join(f"{side:.3g}" for side in spacing)
    return Note(f"{'; '.join(names)}; {voxels} voxels of {sides} mm")


def _set_note(path: Path) -> Note:
    """How many events there are, and how large they are."""
    folder = SetFolder(path)
    locations, models = folder.store.locations(), tuple(folder.recipe.models)
    size = sum(map(file_size, locations.values()))
    return Note(f"{len(locations)} of {sum(map(len, folder.requested))} events, {readable_size(size)}", models=models)


def _note(path: Path, read: Callable[[Path], Note]) -> Note:
    """The note on a file or folder as it is now; in a window, what was known before while a thread reads it."""
    stamp = _stamp(path)
    if bpy.app.background and _known.get(path, _UNKNOWN)[0] != stamp:
        _read(path, stamp, read)
    known, note = _known.get(path, _UNKNOWN)
    if known != stamp and path not in _readers:
        _readers[path] = threading.Thread(target=_read, args=(path, stamp, read), name="mphDRR: reading", daemon=True)
        _readers[path].start()
        timers.soon(_watch, _INTERVAL)
    return note


def _read(path: Path, stamp: _Stamp, read: Callable[[Path], Note]) -> None:
    try:
        with recording.recorded_warnings():
            note = read(path)
    except InputError as error:
        note = Note(reports.in_window(error).removeprefix(f"{path}: "), is_wrong=True)
    except Exception as error:  # such as a file that is being written
        note = Note(f"{path.name}: cannot be read ({type(error).__name__}: {error})", is_wrong=True)
    _known[path] = stamp, note


def _stamp(path: Path) -> _Stamp:
    """The dates of a file or folder and of what lies in it. Panels are drawn often: looks at the disk are 2 s apart."""
    now = time.monotonic()
    return _stamp_at(path, now if bpy.app.background else now // _LOOK)


@functools.lru_cache(maxsize=64)
def _stamp_at(path: Path, now: float) -> _Stamp:
    found = []
    for item in (path, path / RECIPE, path / INDEX, path / EVENTS, path / SHARDS):
        with contextlib.suppress(OSError):
            state = item.stat()
            found.append((state.st_mtime_ns, state.st_size))
    return tuple(found)


def _watch() -> float | None:
    """Have the sidebars drawn where a thread has read."""
    done = [path for path, reader in _readers.items() if not reader.is_alive()]
    for path in done:
        del _readers[path]
    if done:
        windows.redraw_sidebars()
    return _INTERVAL if _readers else None
