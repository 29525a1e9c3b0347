"""What a worker does: make an event of a set and write its file."""

import os
import time
from typing import Any, NamedTuple

from ..files import AnyPath, write_bytes
from ..progress import Progress
from ..recording import recorded_warnings
from .event_files import Place, packed
from .event_maker import EventMaker
from .folders import SetFolder


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

    def __init__(self, folder: AnyPath, threads: int | None = None) -> None:
        self.folder = SetFolder(folder)
        self.maker = EventMaker(self.folder.recipe, threads)
        self._indexed = set(self.folder.index.read())

    def write(self, number: int, progress: Progress | None = None) -> Written:
        """Make an event and write its file, unless another work has; `progress` as in `EventMaker.make`."""
        started, folder = time.monotonic(), self.folder
        place, warnings, size = Place(str(folder.store.event_path(number))), list[str](), 0
        if not folder.is_made(number, place):
            with recorded_warnings() as given:
                event = self.maker.make(number, progress)
            data = packed(event, folder.recipe, self._geometry(), self.maker.threads)
            write_bytes(place.path, data)
            warnings, size = [*event.warnings, *given], len(data)
        if number not in self._indexed:
            folder.index.add(number)
        return Written(number, size or os.stat(place.path).st_size, time.monotonic() - started, tuple(warnings))

    def _geometry(self) -> dict[str, Any]:
        maker = self.maker
        matrices = maker.views.projection_matrices()
        return {"projection_matrix": (matrices, "pixel"), "number": (maker.system.numbers, "1")}
