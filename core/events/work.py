"""Making of an event set: the missing events, one after the other or in parallel, each file written whole."""

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
from .dask_work import check_address, make_in_cluster
from .event_maker import EventMaker
from .event_set import EventSet
from .folders import SetFolder
from .planning import plan
from .pool import make_in_processes
from .recipe import EventRecipe
from .store import SHARD_BYTES, Store
from .writing import EventWriter, Written

_MAX_EVENTS = 10**7
"""Largest number of events in a set."""
_MAX_CHECKED, _CHECK_SECONDS = 1000, 1.0
"""Number of events whose settings are checked before the work begins, and the time, s, after which this stops."""


@dataclass(frozen=True)
class Made:
    """Report on an event that was made and is in the set now."""

    number: int
    """Number of the event."""
    path: Path
    """Path of its file."""
    size: int
    """Bytes of its file."""
    seconds: float
    """Time that the event took, s."""
    done: int
    """Number of events made so far by this call."""
    total: int
    """Number of events that this call makes in all."""


class Making(Iterator[Made]):
    """Iterator that makes the events `missing` in `folder` and reports each; other arguments are as in `making`."""

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
            written = make_in_cluster(folder, missing, dask, workers)
        elif workers > 1:
            written = make_in_processes(folder, missing, workers)
        else:
            written = _make_in_turn(folder, missing, progress)
        self._made = self._report(written)

    def __next__(self) -> Made:
        return next(self._made)

    def _report(self, written: Iterator[Written]) -> Iterator[Made]:
        """Yield a report on each event that was written; show each warning once, for the first event that gave it."""
        patterns: set[str] = set()
        store, unpacked_bytes = self.folder.store, 0
        try:
            for n_made, event in enumerate(written, 1):
                for text in event.warnings:
                    pattern = re.sub(r"[\d.]+", "", text)  # warnings that differ in numbers alone are shown once
                    if pattern not in patterns:
                        patterns.add(pattern)
                        warn(f"event {event.number}: {text}", 3)
                path = store.event_path(event.number)
                yield Made(event.number, path, event.size, event.seconds, n_made, len(self.missing))
                unpacked_bytes += event.size
                if unpacked_bytes >= SHARD_BYTES:
                    _pack_if_sharded(store)
                    unpacked_bytes = 0
        except BaseException:
            with suppress(Exception):  # it may fail for the same reason, such as a full disk
                self.folder.complete_index()
            raise
        self.folder.complete_index()
        remove_leftovers(store.events)  # files that workers were writing when they died
        _pack_if_sharded(store)


def _pack_if_sharded(store: Store) -> None:
    """Move single events into shards where the set has shards, unless another process is doing so."""
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
    """Return an iterator that makes the missing events of a set, as `make` does, and reports each.

    Parameters
    ----------
    recipe, folder, count, first, workers
        The arguments of `make`. Without a count, the events requested by earlier calls are made.
    shard
        ``(i, n)``: make only part i, from 1, of n equal parts, so that several machines can work on one folder.
    progress
        Called as ``progress(steps done, steps)`` within an event, with one worker; may raise `Cancelled`.
    dask
        Address of a Dask scheduler, whose workers make the events and see `folder` under the same path; ``"local"`` for
        `workers` processes of this machine.
    pack
        Whether events go into shards; a set that has shards continues to use them.

    Returns
    -------
    Making
        Iterator over `Made`, a report on each event once it is in the set. Computing begins with the first iteration.

    Raises
    ------
    InputError
        In the same cases as `make`.
    """
    seed_number(first, "first")
    if dask is not None:
        check_address(dask)
    target = SetFolder(folder)
    requested = target.requested if count is None else [range(first, first + whole_number(count, "count"))]
    if not requested:
        raise InputError(f"{target.path}: holds no events: give the number of events to make (-n)")
    maker, stop = EventMaker(recipe), requested[-1].stop
    if stop > _MAX_EVENTS:
        size = readable_size(maker.raw_bytes * stop)
        raise InputError(f"count: at most {_MAX_EVENTS:,} events in a set, got {stop:,}, of up to {size} uncompressed")
    maker.require_memory()
    numbers = _shard_numbers(requested, *shard)
    end = time.monotonic() + _CHECK_SECONDS
    # Settings that contradict each other are refused before anything is computed.
    for number in numbers[:: max(1, len(numbers) // _MAX_CHECKED)]:
        if time.monotonic() < end and not target.store.event_path(number).exists():
            _ = plan(recipe, number).phantom
    missing = target.prepare(recipe, requested, numbers)
    if pack:
        ensure_folder(target.store.shards)
    return Making(target, missing, workers, progress, dask)


def _shard_numbers(requested: Sequence[range], i: int, n: int) -> list[int]:
    """Return the numbers of part i of n, from 1, of the requested events: every number that is i - 1 modulo n."""
    if not (isinstance(i, int) and isinstance(n, int) and 1 <= i <= n):
        raise InputError(f"shard: expected i/n with i from 1 to n, got {i}/{n}")
    return [number for span in requested for number in range(span.start + (i - 1 - span.start) % n, span.stop, n)]


def _make_in_turn(target: SetFolder, missing: Sequence[int], progress: Progress | None) -> Iterator[Written]:
    """Make events in this process, one after the other, and yield each."""
    writer = EventWriter(target.path)
    for number in missing:
        yield writer.write(number, progress)


def make(
    recipe: EventRecipe, folder: AnyPath, count: int, first: int = 0, workers: int = 1, progress: Progress | None = None
) -> EventSet:
    """Make events `first` to ``first + count - 1`` of a recipe; events that the folder holds already are not made again.

    Event i depends on the recipe, its seed and i alone: a set may be made in parts, by any number of workers, on several
    machines. Each file is written whole or not at all, so work that is stopped or killed continues at the next call.

    Parameters
    ----------
    recipe : EventRecipe
        From `read_recipe`. The folder keeps its text and copies of the files that it names.
    folder
        A new folder, or that of an event set of the same recipe.
    count, first
        Number of events, and number of the first.
    workers
        Number of processes, which share the processor's cores. With more than one, a script must call this under
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
        The folder holds another recipe, settings contradict each other (found before anything is made), or a file cannot
        be written.

    Examples
    --------
    >>> events = mph.events.make(mph.events.read_recipe("derenzo.toml"), "set", 1000, workers=2)
    >>> events[0].images("emission", noise_seed=1).shape
    (80, 256, 256)
    """
    count = whole_number(count, "count")
    for event in making(recipe, folder, count, first, workers):
        tell(progress, event.done, event.total)
    return EventSet(folder)
