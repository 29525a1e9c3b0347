"""Progress and cancellation of long work."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` between steps; may raise `Cancelled` to stop the work."""


class Cancelled(Exception):
    """Raised by a progress callback to stop the work. Nothing half-done is left behind."""


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """The progress of part `number`, from 0, of `count` equal parts."""
    return None if progress is None else lambda done, total: progress(number * total + done, count * total)


def in_threads(work: Callable[[Part], None], parts: Sequence[Part], progress: Progress | None = None) -> None:
    """Call ``work(part)`` for all parts, in a thread for each processor core; an exception of `progress` stops the rest."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, _ in enumerate(pool.map(work, parts), 1):
            if progress is not None:
                progress(done, len(parts))  # leaving the loop cancels the parts that have not begun
