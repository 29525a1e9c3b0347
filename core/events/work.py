"""Making the events of a set: which are missing, one after the other, each written whole."""

import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError, warn
from ..files import AnyPath, Locked, ensure_folder, remove_leftovers
from ..memory import readable_size
from ..progress import Progress, tell
from ..validation import seed_number, whole_number
from .dask_work import in_cluster
from .event_maker import EventMaker
from .event_set import EventSet
from .folders import SetFolder
from .planning import plan
from .pool import in_processes
from .recipe import EventRecipe
from .store import SHARD_BYTES, Store
from .writing import EventWriter, Written

_MOST = 10**7
"""Events in a set."""
_CHECKED, _CHECK_SECONDS = 1000, 1.0
"""The settings of so many events are checked before the work begins, for so many seconds at most."""


@dataclass(frozen=True)
class Made:
    """An event that is in the set now."""

    number: int
    path: Path
    size: int  # bytes
    seconds: float  # that it took
    done: int  # events made by this work so far
    total: int  # that it makes in all


class Making(Iterator[Made]):
    """Work on a set: makes the events `missing` in `folder`, and gives each once it is made; the rest as in `making`."""

    def __init__(
        self,
        folder: SetFolder,
        missing: Sequence[int],
        workers: int = 1,
        progress: Progress | None = None,
        dask: str | None = None,
    ) -> None:
        self.folder, self.missing = folder, missing
        if (workers := whole_number(workers, "workers")) > 1:
            workers = min(workers, max(1, len(missing)))
        if dask is not None and missing:
            written = in_cluster(folder, missing, dask, workers)
        elif workers > 1:
            written = in_processes(folder, missing, workers)
        else:
            written = _in_turn(folder, missing, progress)
        self._made = self._follow(written)

    def __next__(self) -> Made:
        return next(self._made)

    def _follow(self, written: Iterator[Written]) -> Iterator[Made]:
        """The events as they are written; each warning is given once, for the first event that it is about."""
        given: set[str] = set()
        store, unpacked = self.folder.store, 0
        try:
            for done, event in enumerate(written, 1):
                for text in event.warnings:
                    words = re.sub(r"[\d.]+", "", text)  # the same with other numbers says nothing new
                    if words not in given:
                        given.add(words)
                        warn(f"event {event.number}: {text}", 3)
                path = store.event_path(event.number)
                yield Made(event.number, path, event.size, event.seconds, done, len(self.missing))
                unpacked += event.size
                if unpacked >= SHARD_BYTES:
                    _pack(store)
                    unpacked = 0
        except BaseException:
            with suppress(Exception):  # of the same full disk, or since Python ends
                self.folder.complete_index()
            raise
        self.folder.complete_index()
        remove_leftovers(store.events)  # of workers that died
        _pack(store)


def _pack(store: Store) -> None:
    """Put what was made into shards where the set has some, unless another work is doing it."""
    if store.shards.is_dir():
        with suppress(Locked):
            store.pack()


def making(
    recipe: EventRecipe,
    folder: AnyPath,
    count: int | None = None,
    first: int = 0,
    workers: int = 1,
    shard: tuple[int, int] = (1, 1),
    progress: Progress | None = None,
    dask: str | None = None,
    pack: bool = False,
) -> Making:
    """Make the events of a set that are missing, one by one, as `make` does.

    Parameters
    ----------
    recipe, folder, count, first, workers
        The same as in `make`. Without a count: the events that were asked for before.
    shard
        ``(i, n)``: only part i, from 1, of n equal ones; several machines may work on one folder so.
    progress
        Called as ``progress(steps done, steps)`` within an event, with one worker; may raise `Cancelled`.
    dask
        Address of a Dask scheduler, whose workers make the events and see `folder` under the same path; ``"local"``: as many
        workers as `workers` on this machine.
    pack
        Whether events go into shards; a set that has some goes on so.

    Returns
    -------
    Making
        Iterates over `Made`: each event, once it is in the set. Nothing is computed before its first.

    Raises
    ------
    InputError
        In the same cases as `make`.
    """
    seed_number(first, "first")
    target = SetFolder(folder)
    asked = target.asked if count is None else [range(first, first + whole_number(count, "count"))]
    if not asked:
        raise InputError(f"{target.path}: it holds no events: say how many to make (-n)")
    maker, most = EventMaker(recipe), asked[-1].stop
    if most > _MOST:
        size = readable_size(maker.raw_bytes * most)
        raise InputError(f"count: at most {_MOST:,} events in a set, got {most:,}, of up to {size} uncompressed")
    maker.require_memory()
    mine = _part(asked, *shard)
    end = time.monotonic() + _CHECK_SECONDS
    # What does not fit together shows before anything is computed.
    for number in mine[:: max(1, len(mine) // _CHECKED)]:
        if time.monotonic() < end and not target.store.event_path(number).exists():
            _ = plan(recipe, number).phantom
    missing = target.prepare(recipe, asked, mine)
    if pack:
        ensure_folder(target.store.shards)
    return Making(target, missing, workers, progress, dask)


def _part(asked: Sequence[range], place: int, parts: int) -> list[int]:
    """The events of a shard: those whose numbers leave the same rest."""
    if not (isinstance(place, int) and isinstance(parts, int) and 1 <= place <= parts):
        raise InputError(f"shard: expected i/n with i from 1 to n, got {place}/{parts}")
    return [n for part in asked for n in range(part.start + (place - 1 - part.start) % parts, part.stop, parts)]


def _in_turn(target: SetFolder, missing: Sequence[int], progress: Progress | None) -> Iterator[Written]:
    writer = EventWriter(target.path)
    for number in missing:
        yield writer.write(number, progress)


def make(
    recipe: EventRecipe,
    folder: AnyPath,
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
        From `read_recipe`. The folder keeps its text and copies of the files that it names.
    folder
        New, or that of an event set of the same recipe.
    count, first
        How many events, from which number.
    workers
        Processes; they share the processor's cores. With more than one, a script calls this under
        ``if __name__ == "__main__":``, as always with Python's processes.
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
