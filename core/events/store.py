"""Storage of a set's events: each in a file of its own, or many in a shard, a tar archive that grows at its end.

A shard's members are the events' files unchanged, so ``tar -x`` extracts them. An interrupted process may leave an
incomplete member at the end of a shard: readers skip it, and the next process overwrites it. An event may be stored twice,
such as after a kill while packing: the first copy that is intact is the event.
"""

import os
import re
import tarfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError, refusing
from ..files import ensure_folder, locked, refuse_links, write_bytes
from ..progress import Progress, tell
from .event_files import FileLocation, verify

EVENTS, SHARDS, LOCK = "events", "shards", ".lock"
SHARD_BYTES = 10**9
"""Size of a shard, bytes: no more events are added to one that has reached it."""
_BATCH = 1 << 26  # bytes written into a shard before the events' own files are removed
_TAR_BLOCK = tarfile.BLOCKSIZE
_EVENT_NAME = re.compile(r"([0-9]{6}|[1-9][0-9]{6,})\.h5")
_HEADING = re.compile(rb"(?=([0-9]{6}|[1-9][0-9]{6,})\.h5\0).{124}([0-7]{11})", re.DOTALL)
"""Heading of a member of a shard: its number and its size, bytes, as octal number."""
_SHARD_NAME = re.compile(r"[0-9]{6,}\.tar")


class Store:
    """Storage of the events' files in the folder of a set: single files and shards."""

    def __init__(self, path: Path) -> None:
        self.events, self.shards = path / EVENTS, path / SHARDS

    def event_path(self, number: int) -> Path:
        """Return the path of an event's own file, which need not exist."""
        return self.events / f"{number:06d}.h5"

    def write_event(self, number: int, data: bytes | memoryview) -> None:
        """Write an event's own file whole or not at all; a link is replaced, not the file that it points to."""
        path = self.event_path(number)
        if path.is_symlink():
            path.unlink(missing_ok=True)
        write_bytes(path, data)

    def copies(self) -> dict[int, list[FileLocation]]:
        """Return all locations of each event by number, in order; only the headings within the shards are read.

        The event's own file comes before members of shards, and a later member before an earlier one.
        """
        copies: dict[int, list[FileLocation]] = {}
        folder = f"{self.events}{os.sep}"
        for name in filter(None, map(_EVENT_NAME.fullmatch, _file_names(self.events))):
            copies[int(name[1])] = [FileLocation(folder + name[0])]
        for shard in reversed(self.shard_paths()):
            for number, location in reversed(list(_members(shard))):
                copies.setdefault(number, []).append(location)
        return dict(sorted(copies.items()))

    def locations(self) -> dict[int, FileLocation]:
        """Return the location of each event by number, in order; of several `copies`, the first intact one.

        If none is intact, it is the first one. An event's only copy is not read.
        """
        return {
            number: copies[0]
            if len(copies) == 1
            else next((copy for copy in copies if _is_intact(number, copy)), copies[0])
            for number, copies in self.copies().items()
        }

    def shard_paths(self) -> list[Path]:
        """Return the paths of the shards, in order."""
        names = filter(_SHARD_NAME.fullmatch, _file_names(self.shards))
        return [self.shards / name for name in sorted(names, key=lambda name: (len(name), name))]

    def pack(self, progress: Progress | None = None, shard_bytes: int = SHARD_BYTES) -> int:
        """Move the events that have files of their own into shards of about `shard_bytes`, and return their number.

        An event's own file is removed after the shard has been written to the disk. `InputError` where another process is
        packing, an event is damaged, or a shard cannot be written; each event then is intact in its own file or in a shard.
        """
        refuse_links(self.events, self.shards)
        ensure_folder(self.shards)
        with locked(self.shards / LOCK, f"{self.shards}: another process is packing this set; wait until it ends"):
            copies, shards = self.copies(), self.shard_paths()
            numbers = [number for number, location in self.locations().items() if not location.offset]
            last, n_packed = int(shards[-1].stem) if shards else 0, 0
            while n_packed < len(numbers):
                n_packed += self._append(self.shards / f"{last:06d}.tar", numbers[n_packed:], copies, shard_bytes)
                last += 1
                tell(progress, n_packed, len(numbers))
            return n_packed

    def _append(
        self, shard: Path, numbers: Sequence[int], copies: Mapping[int, Sequence[FileLocation]], shard_bytes: int
    ) -> int:
        """Move events to the end of a shard until it has `shard_bytes`, and return their number.

        Of events that are in a shard already, by their `copies`, only the own files are removed.
        """
        if shard.is_symlink():  # the file beyond may belong to another set
            return 0
        is_new = not shard.exists()
        members = () if is_new else _members(shard)
        end = max((location.offset + _padded(location.size or 0) for _, location in members), default=0)
        count, flushed, batch = 0, end, list[Path]()
        with refusing(shard, "cannot be written"), open(shard, "xb" if is_new else "r+b") as file:
            try:
                for number in numbers:
                    if end >= shard_bytes:
                        break
                    path = self.event_path(number)
                    verify(FileLocation(str(path)))
                    data = path.read_bytes()
                    # Where the shards hold the same event already, only its own file has to be removed.
                    if all(read_bytes(copy) != data for copy in copies[number] if copy.offset):
                        _write_member(file, end, path.name, data)
                        end += _TAR_BLOCK + _padded(len(data))
                    count += 1
                    batch.append(path)
                    if end - flushed >= _BATCH:
                        _flush(file, end, batch)
                        flushed, batch = end, []
            finally:
                file.truncate(end)  # cut off a member that was not completed
                _flush(file, end, batch)
        return count

    def unpack(self, progress: Progress | None = None, shards: Collection[Path] | None = None) -> int:
        """Move the events of `shards` (default: all) into files of their own, and return the number of these events.

        The shards are removed. Damaged events are dropped: `check` then reports them as missing. `InputError` where a file
        cannot be written.
        """
        refuse_links(self.events, self.shards)
        shards = self.shard_paths() if shards is None else shards
        if not shards:
            return 0
        with locked(self.shards / LOCK, f"{self.shards}: another process is packing this set; wait until it ends"):
            packed = [(n, location) for n, location in self.locations().items() if Path(location.path) in shards]
            n_unpacked = 0
            for n_read, (number, location) in enumerate(packed, 1):
                if _is_intact(number, location):
                    self.write_event(number, read_bytes(location))
                    n_unpacked += 1
                tell(progress, n_read, len(packed))
            for shard in shards:
                with refusing(shard, "cannot be removed"):
                    shard.unlink()
        return n_unpacked


def file_size(location: FileLocation) -> int:
    """Return the size of an event's file, bytes."""
    return os.stat(location.path).st_size if location.size is None else location.size


def read_bytes(location: FileLocation) -> bytes:
    """Read the bytes of an event's file."""
    with refusing(location.path, "cannot be read"), open(location.path, "rb") as file:
        file.seek(location.offset)
        return file.read(-1 if location.size is None else location.size)


def _is_intact(number: int, location: FileLocation) -> bool:
    """Return whether a file is that of event `number` and all its bytes agree with its checksums."""
    try:
        return verify(location).event == number
    except InputError:
        return False


def _members(shard: Path) -> Iterator[tuple[int, FileLocation]]:
    """Yield the number and the location of each complete event in a shard, also of those behind a damaged heading."""
    with refusing(shard, "cannot be read"), open(shard, "rb", buffering=0) as file:
        position, end = 0, file.seek(0, os.SEEK_END)
        while position + _TAR_BLOCK < end:
            file.seek(position)
            heading = _HEADING.match(file.read(_TAR_BLOCK))
            position += _TAR_BLOCK
            if heading is not None and position + (size := int(heading[2], 8)) <= end:
                yield int(heading[1]), FileLocation(str(shard), position, size)
                position += _padded(size)


def _write_member(file: BinaryIO, position: int, name: str, data: bytes) -> None:
    """Write an event's file as a member of a tar archive, at a position in bytes."""
    heading = tarfile.TarInfo(name)  # without time and owner, so that the same events give the same bytes
    heading.size = len(data)
    file.seek(position)
    file.write(heading.tobuf(tarfile.USTAR_FORMAT))
    file.write(data.ljust(_padded(len(data)), b"\0"))


def _flush(file: BinaryIO, end: int, packed_files: Sequence[Path]) -> None:
    """Force a shard to the disk, with an archive's end mark, and remove the own files of the events in it."""
    file.seek(end)
    file.write(bytes(2 * _TAR_BLOCK))
    file.flush()
    os.fsync(file.fileno())
    for path in packed_files:
        path.unlink(missing_ok=True)


def _padded(size: int) -> int:
    """Return a size rounded up to whole blocks of tar."""
    return -(-size // _TAR_BLOCK) * _TAR_BLOCK


def _file_names(folder: Path) -> list[str]:
    """Return the names of the files in a folder; none where there is no folder."""
    with refusing(folder, "cannot be read"):
        return os.listdir(folder) if folder.exists() else []
