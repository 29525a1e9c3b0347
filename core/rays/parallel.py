"""Work on several threads: results in order with few tasks in flight, sums of volumes, and the number of threads."""

import functools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

from ..arrays import ArrayOrTensor
from ..memory import cores
from ..validation import strict_whole

In = TypeVar("In")
Out = TypeVar("Out")

# Tasks handed to each worker ahead of need, so that no worker waits.
_TASKS_AHEAD = 4


def in_order(function: Callable[[In], Out], items: Iterable[In], workers: int) -> Iterator[Out]:
    """Yield ``function(item)`` of every item, in order, computed on `workers` threads.

    Items are taken when there is room for them. When the iterator is closed or fails, no task goes on running.
    Called from such a thread it computes one item after the other: the threads may all be waiting for each other.
    """
    if workers == 1 or getattr(_thread, "is_worker", False):
        yield from map(function, items)
        return
    running: deque[Future[Out]] = deque()
    try:
        for item in items:
            running.append(_pool(workers).submit(function, item))
            if len(running) > _TASKS_AHEAD * workers:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
    finally:
        for task in running:
            task.cancel()
        wait(running)


def run_all(function: Callable[[In], None], items: Iterable[In], workers: int) -> None:
    """Run ``function(item)`` for every item on `workers` threads."""
    for _ in in_order(function, items, workers):
        pass


_thread = threading.local()


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """Return threads that stay: to start them for every call would take longer than the work of a short one."""
    return ThreadPoolExecutor(workers, "mphdrr", lambda: setattr(_thread, "is_worker", True))


if hasattr(os, "register_at_fork"):  # a forked process, such as a data loader's worker, has none of these threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def sum_volumes(volumes: list[ArrayOrTensor], workers: int) -> ArrayOrTensor:
    """Return the sum of `volumes`, computed in the first of them, on `workers` threads."""
    total, *addends = (volume.reshape(-1) for volume in volumes)
    size = -(-len(total) // len(volumes))

    def add(first: int) -> None:
        """Add up the stretch of all volumes that begins at the flat index `first`."""
        for addend in addends:
            total[first : first + size] += addend[first : first + size]

    run_all(add, range(0, len(total), size) if addends else [], workers)
    return volumes[0]


_usual: int | None = None


def set_usual_threads(threads: int | None) -> None:
    """Set the number of threads that is used where none is given; None: as many as the job has cores."""
    global _usual
    _usual = None if threads is None else thread_count(threads)


def thread_count(threads: int | None) -> int:
    """Return `threads`, or for None the number of `set_usual_threads`, or that of the job's cores (`memory.cores`)."""
    if threads is None:
        return cores() if _usual is None else _usual
    return strict_whole(threads, "threads", "a whole number of at least 1")
