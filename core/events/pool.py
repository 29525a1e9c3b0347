"""Events made in several processes, of which any may be killed."""

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

_MOST_BREAKS = 3
"""How often workers may end one after the other without an event made between."""

_writer: EventWriter | None = None


def in_processes(target: SetFolder, numbers: Sequence[int], workers: int) -> Iterator[Written]:
    """Make events of a set that is prepared, as they come. What was under way in a worker that died is done again.

    Raises
    ------
    InputError
        That of a worker, such as a full disk; there is not enough memory; workers die again and again; or this is Blender.
    """
    if not numbers:
        return
    if __name__.startswith("bl_ext."):  # an extension's name, which no other process knows
        advice = "mphdrr as a Python package takes more, and several commands share a set by --shard"
        raise InputError(f"workers: expected 1 within Blender, which takes all cores, got {workers}; {advice}")
    target.maker.require_memory(workers)
    waiting, breaks = deque(numbers), 0
    while waiting:
        under_way: dict[Future[Written], int] = {}
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (target.path, threads_each(workers)))
        try:
            while waiting or under_way:
                while waiting and len(under_way) < workers + 1:  # one more, so that no worker waits for the next
                    with _interrupts_held():
                        under_way[pool.submit(_write, waiting[0])] = waiting[0]
                    waiting.popleft()
                done, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in sorted(done, key=under_way.__getitem__):
                    written = future.result()
                    del under_way[future]
                    breaks = 0
                    yield written
        except BrokenProcessPool:
            breaks += 1
            missing = sorted(under_way.values())
            if breaks == _MOST_BREAKS:
                event = f"event {missing[0] if missing else waiting[0]}"
                why = 'out of memory: try fewer workers; a script calls this under if __name__ == "__main__":'
                ended = f"its worker ended {breaks} times before it was made"
                raise InputError(f"{event}: {ended} (killed, or {why})") from None
            waiting.extendleft(reversed(missing))
        except (KeyboardInterrupt, GeneratorExit):  # nobody waits for what is under way
            for worker in list(pool._processes.values()):
                worker.kill()
            pool.shutdown(cancel_futures=True)
            remove_leftovers(target.store.events)
            raise
        finally:
            pool.shutdown(cancel_futures=True)  # what is under way is finished: it counts


def threads_each(workers: int) -> int:
    """Threads for each worker: together they use all cores of the job."""
    return max(1, cores() // workers)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C comes after this block, and never to processes that begin in it: their parent ends them."""
    if sys.platform != "win32":
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(folder: Path, threads: int) -> None:
    """Begin a worker."""
    global _writer
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it could not be held
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _writer = EventWriter(folder, threads)


def _end_with_parent() -> None:
    """End this process when its parent is killed, which would otherwise leave it waiting for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _write(number: int) -> Written:
    assert _writer is not None
    return _writer.write(number)
