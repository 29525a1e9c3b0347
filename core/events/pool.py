"""Making of events in several processes, each of which may be killed."""

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from pathlib import Path

from ..errors import InputError
from ..files import remove_leftovers
from ..memory import cores
from .folders import SetFolder
from .writing import EventWriter, Written

_MAX_BREAKS = 3
"""Number of successive worker failures, without an event between them, after which the work is given up."""

_writer: EventWriter | None = None
"""The writer of this process where it is a worker."""


def make_in_processes(target: SetFolder, numbers: Sequence[int], workers: int) -> Iterator[Written]:
    """Make events of a prepared set in several processes and yield them in order of completion.

    Events that were under way when a worker died are made again.

    Raises
    ------
    InputError
        A worker raised it, such as for a full disk; memory does not suffice; workers die again and again; or this process
        is Blender.
    """
    if not numbers:
        return
    if __name__.startswith("bl_ext."):  # other processes cannot import a Blender extension
        advice = "use the Python package for more, or several commands with --shard"
        raise InputError(f"workers: expected 1 within Blender, which uses all cores, got {workers}; {advice}")
    target.maker.require_memory(workers)
    waiting, n_breaks = deque(numbers), 0
    while waiting:
        under_way: dict[Future[Written], int] = {}
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _start, (target.path, threads_per_worker(workers)))
        try:
            while waiting or under_way:
                while waiting and len(under_way) < workers + 1:  # one more than workers, so that none has to wait
                    with _hold_interrupts():
                        under_way[pool.submit(_write_event, waiting[0])] = waiting[0]
                    waiting.popleft()
                finished, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in sorted(finished, key=under_way.__getitem__):
                    written = future.result()
                    del under_way[future]
                    n_breaks = 0
                    yield written
        except BrokenProcessPool:
            n_breaks += 1
            missing = sorted(under_way.values())
            if n_breaks == _MAX_BREAKS:
                event = f"event {missing[0] if missing else waiting[0]}"
                reasons = 'out of memory: try fewer workers; a script calls this under if __name__ == "__main__":'
                failure = f"its worker ended {n_breaks} times before it was made"
                raise InputError(f"{event}: {failure} (killed, or {reasons})") from None
            waiting.extendleft(reversed(missing))
        except (KeyboardInterrupt, GeneratorExit):  # the events under way are not wanted any more
            for worker in list(pool._processes.values()):
                worker.kill()
            pool.shutdown(cancel_futures=True)
            remove_leftovers(target.store.events)
            raise
        finally:
            pool.shutdown(cancel_futures=True)  # events under way are finished and written


def threads_per_worker(workers: int) -> int:
    """Return the number of threads for each of `workers` processes that together use all cores of the job."""
    return max(1, cores() // workers)


@contextmanager
def _hold_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the end of this block, and keep it from processes that start in it: their parent ends them."""
    if sys.platform != "win32":
        earlier_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_SETMASK, earlier_mask)


def _start(folder: Path, threads: int) -> None:
    """Prepare a worker process for the events of a set."""
    global _writer
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Windows cannot hold it back
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    _writer = EventWriter(folder, threads)


def _exit_with_parent() -> None:
    """Exit this process when its parent is killed; it would wait for work forever otherwise."""
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


def _write_event(number: int) -> Written:
    """Make and write an event in a worker process."""
    assert _writer is not None
    return _writer.write(number)
