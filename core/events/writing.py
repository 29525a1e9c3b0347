"""What a worker does: make an event of a set and write its file."""

import os
import time
from typing import Any, NamedTuple

from ..files import replacing
from ..progress import Progress
from ..recording import recorded_warnings
from .event_files import packed
from .folders import SetFolder
from .making import EventMaker


class Written(NamedTuple):
    """An event's file, as a worker wrote it."""

    number: int
    size: int  # bytes
    seconds: float
    warnings: tuple[str, ...]


class EventWriter:
    """Makes events of a set that is prepared and writes their files: what a worker does.

    `threads` is how many an event takes, by default one per core.
    """

    def __init__(self, folder: str | os.PathLike[str], threads: int | None = None) -> None:
        self.folder = SetFolder(folder)
        self.maker = EventMaker(self.folder.recipe, threads)

    def write(self, number: int, progress: Progress | None = None) -> Written:
        """Make an event and write its file; `progress` as of `EventMaker.make`."""
        started, folder = time.monotonic(), self.folder
        folder.remove_leftovers(number)
        with recorded_warnings() as said:
            event = self.maker.make(number, progress)
        data = packed(event, folder.recipe, self._geometry(), self.maker.threads)
        with replacing(folder.event_path(number)) as temporary:
            temporary.write_bytes(data)
        return Written(number, len(data), time.monotonic() - started, (*event.warnings, *said))

    def _geometry(self) -> dict[str, Any]:
        maker = self.maker
        matrices = maker.views.projection_matrices()
        return {"projection_matrix": (matrices, "pixel"), "number": (maker.system.numbers, "1")}
