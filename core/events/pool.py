"""Events made in several processes."""

import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from .folders import SetFolder
from .writing import EventWriter, Written

_writer: EventWriter | None = None


def in_processes(target: SetFolder, numbers: Sequence[int], workers: int) -> Iterator[Written]:
    """Make events of a set that is prepared, in any order."""
    threads = max(1, (os.cpu_count() or 1) // workers)
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin, (target.path, threads)) as pool:
        yield from pool.map(_write, numbers)


def _begin(folder: os.PathLike[str], threads: int) -> None:
    global _writer
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the work
    _writer = EventWriter(folder, threads)


def _write(number: int) -> Written:
    assert _writer is not None
    return _writer.write(number)
