"""Shards of WebDataset: tar archives, whose members of one key, 000012.truth.npy.gz, 000012.radon96.npy.gz, are an event.

The images of a model are 000012.NAME.npy.gz, and 000012.json is the event's record (`ExportSelection.record`); names of
uncompressed arrays end in .npy. A shard holds events of one split, ``train-000003.tar``, so that a brace pattern or a glob
selects the events for training. The same set gives the same bytes.
"""

import gzip
import io
import json
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path

from ...files import replacing
from ...validation import strict_whole
from ..event_set import Event
from .arrays import npy_bytes
from .layout import ExportLayout, ExportPart, ExportSelection, Row

SHARD_BYTES = 10**9
"""Approximate size of a shard, bytes, where its number of events is not given."""


class WebDataset(ExportLayout):
    """Tar archives of `events_per_shard` events, by default about a gigabyte; `uncompressed`: members without gzip."""

    def __init__(
        self, selection: ExportSelection, *, events_per_shard: int | None = None, uncompressed: bool = False
    ) -> None:
        super().__init__(selection)
        self.compressed = not uncompressed
        if events_per_shard is None:
            events_per_shard = max(1, SHARD_BYTES // self.event_bytes)
        self.events_per_shard = strict_whole(events_per_shard, "events_per_shard", "a whole number of at least 1")

    def parts(self, rows: list[Row]) -> list[ExportPart]:
        """Return the parts of the export: the shards, .tar files, each with the events that it holds."""
        parts = []
        for split in dict.fromkeys(row["split"] for row in rows):
            members = [row["i"] for row in rows if row["split"] == split]
            for first in range(0, len(members), self.events_per_shard):
                name = f"{split}-{first // self.events_per_shard:06d}.tar"
                parts.append(ExportPart((name,), tuple(members[first : first + self.events_per_shard])))
        return parts

    def write(self, part: ExportPart, rows: list[Row], folder: Path, report_event: Callable[[], None]) -> None:
        """Write a shard into a folder; call `report_event` after each event."""
        path, tar_format = folder / part.files[0], tarfile.USTAR_FORMAT
        with replacing(path) as temporary, tarfile.open(temporary, "w", format=tar_format) as tar:
            for i in part.events:
                for name, content in self.contents(rows[i], self.selection.events[i]):
                    member = tarfile.TarInfo(name)  # without time and owner, so that the same set gives the same bytes
                    member.size = len(content)
                    tar.addfile(member, io.BytesIO(content))
                report_event()

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes]]:
        """Yield the name and the content of each file of an event within the .tar."""
        key = f"{row['i']:06d}"
        for name, array in self.selection.arrays(event):
            if self.compressed:  # no time stamp, so that the same set gives the same bytes
                yield f"{key}.{name}.npy.gz", gzip.compress(npy_bytes(array), 4, mtime=0)
            else:
                yield f"{key}.{name}.npy", npy_bytes(array)
        yield f"{key}.json", json.dumps(self.selection.record(event)).encode()
