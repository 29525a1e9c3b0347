"""Task of a worker process: to make an event of a set and write its file."""

import os
import time
from typing import Any, NamedTuple

from ..files import AnyPath
from ..progress import Progress
from ..recording import recorded_warnings
from .event_files import FileLocation, pack
from .event_maker import EventMaker
from .folders import SetFolder


class Written(NamedTuple):
    """Report of a worker on an event whose file it has written."""

    number: int  # number of the event
    size: int  # bytes of the file
    seconds: float  # time that the event took
    warnings: tuple[str, ...]  # warnings that the event gave


class EventWriter:
    """Writer of a set's events, in a folder that `SetFolder.prepare` has prepared.

    `threads` is the number of threads that make an event, by default one per core.
    """

    def __init__(self, folder: AnyPath, threads: int | None = None) -> None:
        self.folder = SetFolder(folder)
        self.maker = EventMaker(self.folder.recipe, threads)
        self._indexed = set(self.folder.index.read())

    def write(self, number: int, progress: Progress | None = None) -> Written:
        """Make an event and write its file and row, unless another process has; `progress` is as in `EventMaker.make`."""
        started, folder = time.monotonic(), self.folder
        location, warnings, size = FileLocation(str(folder.store.event_path(number))), list[str](), 0
        if not folder.is_made(number, location):
            with recorded_warnings() as other_warnings:
                event = self.maker.make(number, progress)
            data = pack(event, folder.recipe, self._geometry_arrays(), self.maker.threads)
            folder.store.write_event(number, data)
            warnings, size = [*event.warnings, *other_warnings], len(data)
        if number not in self._indexed:
            folder.index.add(number)
        return Written(number, size or os.stat(location.path).st_size, time.monotonic() - started, tuple(warnings))

    def _geometry_arrays(self) -> dict[str, Any]:
        """Return the projection matrices (M, 3, 4) and the modules' numbers (M,), with units, for an event's file."""
        matrices, numbers = self.maker.views.projection_matrices(), self.maker.system.numbers
        return {"projection_matrix": (matrices, "pixel"), "number": (numbers, "1")}
