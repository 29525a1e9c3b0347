"""Progress and cancellation of long work."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from .errors import Cancelled as Cancelled
from .memory import cores

Part = TypeVar("Part")

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` between steps; may raise `Cancelled` to stop the work."""
Stages = Callable[[str], Progress | None]
"""Begins a stage of the work, such as "projecting", and gives its progress callback."""


class StagedProgress:
    """The progress callback of a whole work, whose `stages` have words and callbacks of their own (`stages_of`)."""

    def __init__(self, stages: Stages, label: str) -> None:
        self.stages = stages
        self._whole = stages(label)

    def __call__(self, done: int, total: int) -> None:
        """Say how far the whole work is."""
        if self._whole is not None:
            self._whole(done, total)


def stages_of(progress: Progress | None) -> Stages:
    """What begins the stages of a work with this callback; of one without stages, `progress` counts each of them."""
    return progress.stages if isinstance(progress, StagedProgress) else lambda words: progress


def tell(progress: Progress | None, done: int, total: int) -> None:
    """Call a progress callback, if there is one."""
    if progress is not None:
        progress(done, total)


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """The progress of part `number`, from 0, of `count` equal parts."""
    return None if progress is None else lambda done, total: progress(number * total + done, count * total)


def in_threads(work: Callable[[Part], None], parts: Sequence[Part], progress: Progress | None = None) -> None:
    """Call ``work(part)`` for all parts, in a thread for each core of the job; an exception of `progress` stops the rest."""
    with ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(work, parts), 1):
            tell(progress, done, len(parts))  # leaving the loop cancels the parts that have not begun
