"""WebDataset: tar archives, shards, whose members of one key are an event: 000012.truth.npy.gz, 000012.radon96.npy.gz, ...

A model's images are 000012.NAME.npy.gz, 000012.json says the rest (`record`); uncompressed, they end in .npy. Shards are of
one split each, ``train-000003.tar``, so that a brace pattern or a glob names what is trained on. The same set makes the same
bytes.
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
from .arrays import npy
from .layout import Chosen, Layout, Part, Row
from .record import record

SHARD_BYTES = 10**9
"""About how large a shard is unless its number of events is given."""


class WebDataset(Layout):
    """`events_per_shard`: how many events are in a shard; default: as many as make about a gigabyte uncompressed."""

    def __init__(self, chosen: Chosen, *, events_per_shard: int | None = None, uncompressed: bool = False) -> None:
        super().__init__(chosen)
        self.packed = not uncompressed
        if events_per_shard is None:
            events_per_shard = max(1, SHARD_BYTES // self.event_bytes)
        self.events_per_shard = strict_whole(events_per_shard, "events_per_shard", "a whole number of at least 1")

    def parts(self, rows: list[Row]) -> list[Part]:
        """A shard each."""
        parts = []
        for split in dict.fromkeys(row["split"] for row in rows):
            members = [row["i"] for row in rows if row["split"] == split]
            for first in range(0, len(members), self.events_per_shard):
                name = f"{split}-{first // self.events_per_shard:06d}.tar"
                parts.append(Part((name,), tuple(members[first : first + self.events_per_shard])))
        return parts

    def write(self, part: Part, rows: list[Row], folder: Path, written: Callable[[], None]) -> None:
        """Write a shard."""
        path, kind = folder / part.files[0], tarfile.USTAR_FORMAT
        with replacing(path) as temporary, tarfile.open(temporary, "w", format=kind) as tar:
            for i in part.events:
                for name, content in self.contents(rows[i], self.chosen.events[i]):
                    member = tarfile.TarInfo(name)  # of no time and nobody
                    member.size = len(content)
                    tar.addfile(member, io.BytesIO(content))
                written()

    def contents(self, row: Row, event: Event) -> Iterator[tuple[str, bytes]]:
        """The members of an event."""
        key = f"{row['i']:06d}"
        for name, array in self.chosen.arrays(event):
            if self.packed:  # of no time, so that the same set makes the same bytes
                yield f"{key}.{name}.npy.gz", gzip.compress(npy(array), 4, mtime=0)
            else:
                yield f"{key}.{name}.npy", npy(array)
        yield f"{key}.json", json.dumps(record(self.chosen, event)).encode()
