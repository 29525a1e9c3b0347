"""Making the events of a set: which are missing, one after the other, each written whole."""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError, warn
from ..progress import Progress, tell
from ..validation import whole_number
from .dask_work import in_cluster
from .event_set import EventSet
from .folders import SetFolder
from .making import EventMaker
from .planning import plan
from .pool import in_processes
from .recipe import EventRecipe
from .writing import EventWriter, Written


@dataclass(frozen=True)
class Made:
    """An event that is in the set now."""

    number: int
    path: Path
    size: int  # bytes
    seconds: float  # that it took
    done: int  # events made by this work so far
    total: int  # that it makes in all


def making(
    recipe: EventRecipe,
    folder: str | os.PathLike[str],
    count: int | None = None,
    first: int = 0,
    workers: int = 1,
    shard: tuple[int, int] = (1, 1),
    progress: Progress | None = None,
    dask: str | None = None,
) -> Iterator[Made]:
    """Make the events of a set that are missing, one by one, as `make` does.

    Parameters
    ----------
    recipe, folder, count, first, workers
        As of `make`. Without a count: the events that were asked for before.
    shard
        ``(i, n)``: only part i, from 1, of n equal ones; several machines may work on one folder so.
    progress
        Called as ``progress(steps done, steps)`` within an event, with one worker; may raise `Cancelled`.
    dask
        Address of a Dask scheduler, whose workers make the events and see `folder` under the same path; ``"local"``: as many
        workers as `workers` on this machine.

    Yields
    ------
    Made
        Each event, once it is in the set.

    Raises
    ------
    InputError
        As of `make`.
    """
    target, missing = prepare(recipe, folder, count, first, shard)
    if dask is not None and missing:
        return followed(target, in_cluster(target, missing, dask, whole_number(workers, "workers")), len(missing))
    return _made(target, missing, workers, progress)


def making_again(folder: str | os.PathLike[str], numbers: Sequence[int], workers: int = 1) -> Iterator[Made]:
    """Make some events of a set anew, as `making` does, whatever is there."""
    return _made(SetFolder(folder), numbers, workers)


def _made(target: SetFolder, missing: Sequence[int], workers: int, progress: Progress | None = None) -> Iterator[Made]:
    workers = whole_number(workers, "workers")
    if workers > 1 and len(missing) > 1:
        written = in_processes(target, missing, min(workers, len(missing)))
    else:
        written = _in_turn(target, missing, progress)
    return followed(target, written, len(missing))


def followed(target: SetFolder, written: Iterator[Written], total: int) -> Iterator[Made]:
    """What is said of events as they are written; each warning is given once, for the first event that it is of."""
    said: set[str] = set()
    for done, event in enumerate(written, 1):
        for text in event.warnings:
            if (words := re.sub(r"[\d.]+", "", text)) not in said:  # the same with other numbers says nothing new
                said.add(words)
                warn(f"event {event.number}: {text}", 3)
        yield Made(event.number, target.event_path(event.number), event.size, event.seconds, done, total)


def prepare(
    recipe: EventRecipe,
    folder: str | os.PathLike[str],
    count: int | None = None,
    first: int = 0,
    shard: tuple[int, int] = (1, 1),
) -> tuple[SetFolder, list[int]]:
    """Put recipe, copies and index into a set's folder; and the numbers of the shard's events that are still missing."""
    if isinstance(first, bool) or not isinstance(first, int) or first < 0:
        raise InputError(f"first: expected a whole number of at least 0, got {first!r}")
    part, parts = shard
    if not (isinstance(part, int) and isinstance(parts, int) and 1 <= part <= parts):
        raise InputError(f"shard: expected i/n with i from 1 to n, got {part}/{parts}")
    target = SetFolder(folder)
    numbers = target.planned() if count is None else list(range(first, first + whole_number(count, "count")))
    if not numbers:
        raise InputError(f"{target.path}: it holds no events: say how many to make (-n)")
    mine = [number for number in numbers if number % parts == part - 1]
    for number in mine:  # what does not fit together shows before the first is computed; a torso's check takes 20 ms
        if not target.event_path(number).exists():
            _ = plan(recipe, number).phantom
    EventMaker(recipe).require_memory()
    recipe = target.prepare(recipe)
    target.write_index([*target.planned(), *numbers])
    return target, [number for number in mine if not target.is_made(number, recipe.fingerprint)]


def _in_turn(target: SetFolder, missing: Sequence[int], progress: Progress | None) -> Iterator[Written]:
    writer = EventWriter(target.path)
    for number in missing:
        yield writer.write(number, progress)


def make(
    recipe: EventRecipe,
    folder: str | os.PathLike[str],
    count: int,
    first: int = 0,
    workers: int = 1,
    progress: Progress | None = None,
) -> EventSet:
    """Make events `first` to ``first + count - 1`` of a recipe; those that the folder holds already are kept.

    Event i depends on the recipe, its seed and i alone: a set may be made in parts, by any number of workers, on several
    machines. Each file is written whole or not at all, so work that is stopped, in whatever way, goes on where it was.

    Parameters
    ----------
    recipe : EventRecipe
        As of `read_recipe`. The folder keeps its text and copies of the files that it names.
    folder
        New, or that of an event set of the same recipe.
    count, first
        How many events, from which number.
    workers
        Processes; they share the processor's cores. With more than one, a script calls this under
        ``if __name__ == "__main__":``, as of all of Python's processes.
    progress
        Called as ``progress(events done, events)``; may raise `Cancelled`.

    Returns
    -------
    EventSet
        All events in the folder.

    Raises
    ------
    InputError
        Another recipe in the folder, settings that do not go together (before anything is made), or a file that cannot be
        written.

    Examples
    --------
    >>> events = mph.events.make(mph.events.read_recipe("derenzo.toml"), "set", 1000, workers=2)
    >>> events[0].images("emission", noise_seed=1).shape
    (80, 256, 256)
    """
    count = whole_number(count, "count")
    for made in making(recipe, folder, count, first, workers):
        tell(progress, made.done, made.total)
    return EventSet(folder)
