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
"""Called as ``stages(label)`` when a stage such as "projecting" begins; returns the stage's progress callback."""


class StagedProgress:
    """Progress callback of a job with stages, each of which has a label and a callback of its own (`stages_of`)."""

    def __init__(self, stages: Stages, label: str) -> None:
        self.stages = stages
        self._job = stages(label)

    def __call__(self, n_done: int, total: int) -> None:
        """Report that `n_done` of `total` steps of the whole job are done."""
        if self._job is not None:
            self._job(n_done, total)


def stages_of(progress: Progress | None) -> Stages:
    """Return the stage starter of a `StagedProgress`; for a plain callback, one that gives `progress` to every stage."""
    return progress.stages if isinstance(progress, StagedProgress) else lambda label: progress


def tell(progress: Progress | None, n_done: int, total: int, remark: Callable[[], str] | None = None) -> None:
    """Call ``progress(n_done, total)`` unless it is None, after its attribute `remark`, if it has one, was set.

    A `remark` returns a text on the last step, such as its loss.
    """
    if progress is not None:
        if remark is not None and hasattr(progress, "remark"):
            progress.remark = remark
        progress(n_done, total)


def part_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Return the progress callback of part `number`, from 0, of a job of `count` equal parts that reports to `progress`."""
    return None if progress is None else lambda done, total: progress(number * total + done, count * total)


def in_threads(work: Callable[[Part], None], parts: Sequence[Part], progress: Progress | None = None) -> None:
    """Call ``work(part)`` for all parts in a pool of threads, one for each core of the job.

    An exception that `progress` raises stops the parts that have not begun.
    """
    with ThreadPoolExecutor(cores()) as pool:
        for n_done, _ in enumerate(pool.map(work, parts), 1):
            tell(progress, n_done, len(parts))  # an exception leaves the block, which cancels the remaining parts
