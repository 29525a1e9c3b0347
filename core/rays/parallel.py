"""Threads: results in order with few tasks in flight, and the sum of several volumes."""

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

# Tasks handed to each worker ahead of need, so that none waits for the others.
_TASKS_AHEAD = 4


def in_order(function: Callable[[In], Out], items: Iterable[In], workers: int) -> Iterator[Out]:
    """``function(item)`` of every item, in order, on `workers` threads.

    Items are taken when there is room for them. When the iterator is closed or fails, no task goes on running.
    A task that comes here itself does its parts one by one: the threads may all be waiting for such parts.
    """
    if workers == 1 or getattr(_own, "is_worker", False):
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


_own = threading.local()


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """Threads that stay: starting some for every call would cost a short one more than its work."""
    return ThreadPoolExecutor(workers, "mphdrr", lambda: setattr(_own, "is_worker", True))


if hasattr(os, "register_at_fork"):  # a forked process, such as a data loader's worker, has none of these threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def sum_of(volumes: list[ArrayOrTensor], workers: int) -> ArrayOrTensor:
    """Their sum, in the first of them."""
    total, *others = (volume.reshape(-1) for volume in volumes)
    size = -(-len(total) // len(volumes))

    def add(first: int) -> None:
        for other in others:
            total[first : first + size] += other[first : first + size]

    run_all(add, range(0, len(total), size) if others else [], workers)
    return volumes[0]


_usual: int | None = None


def set_usual_threads(threads: int | None) -> None:
    """How many threads are used where nobody says; None: as many as the job has cores."""
    global _usual
    _usual = None if threads is None else thread_count(threads)


def thread_count(threads: int | None) -> int:
    """`threads`, or the usual number: that of `set_usual_threads`, or of the cores that the job has (`memory.cores`)."""
    if threads is None:
        return cores() if _usual is None else _usual
    return strict_whole(threads, "threads", "a whole number of at least 1")
