"""Where the files of a set's events are: each by itself, or many in a shard, a tar archive that grows at its end.

A shard's members are the events' files as they are, so ``tar -x`` gives them back. What an interrupted work has left at the
end of a shard is no whole member: readers leave it out, the next work writes over it.
"""

import os
import re
import tarfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError, refusing
from ..files import locked, write_bytes
from ..progress import Progress, tell
from .event_files import Place, verify

EVENTS, SHARDS, LOCK = "events", "shards", ".lock"
SHARD_BYTES = 10**9
"""About how large a shard becomes."""
_BATCH = 1 << 26  # bytes that are put into a shard before the files that they come from are removed
_TAR = tarfile.BLOCKSIZE
_EVENT = re.compile(r"([0-9]{6}|[1-9][0-9]{6,})\.h5")
_SHARD = re.compile(r"[0-9]{6,}\.tar")


class Store:
    """The events' files in the folder of a set."""

    def __init__(self, path: Path) -> None:
        self.events, self.shards = path / EVENTS, path / SHARDS

    def event_path(self, number: int) -> Path:
        """The file of an event by itself."""
        return self.events / f"{number:06d}.h5"

    def places(self) -> dict[int, Place]:
        """Where each event is, by its number, in order; nothing of the files is read but the shards' headings.

        Of an event that is there twice, the file by itself counts, then the one written last.
        """
        found: dict[int, Place] = {}
        for shard in self.shard_paths():
            found |= dict(_members(shard))
        folder = f"{self.events}{os.sep}"
        for name in filter(None, map(_EVENT.fullmatch, _names(self.events))):
            found[int(name[1])] = Place(folder + name[0])
        return dict(sorted(found.items()))

    def shard_paths(self) -> list[Path]:
        """The shards, in order."""
        names = filter(_SHARD.fullmatch, _names(self.shards))
        return [self.shards / name for name in sorted(names, key=lambda name: (len(name), name))]

    def alone(self) -> list[int]:
        """The events that have a file of their own."""
        return [number for number, place in self.places().items() if not place.offset]

    def pack(self, progress: Progress | None = None, shard_bytes: int = SHARD_BYTES) -> int:
        """Put the events that have files of their own into shards of about so many bytes; how many.

        An event's own file is removed when the shard is on the disk. `InputError` where another work is packing, an event
        is damaged, or a shard cannot be written: then all events are where they were or in a shard, whole.
        """
        with refusing(self.shards, "cannot be made"):
            self.shards.mkdir(exist_ok=True)
        with locked(self.shards / LOCK, f"{self.shards}: another work is packing this set; wait for its end"):
            numbers, there = self.alone(), self.shard_paths()
            packed = dict(member for shard in there for member in _members(shard))
            last, done = int(there[-1].stem) if there else 0, 0
            while done < len(numbers):
                done += self._append(self.shards / f"{last:06d}.tar", numbers[done:], packed, shard_bytes)
                last += 1
                tell(progress, done, len(numbers))
            return done

    def _append(self, shard: Path, numbers: Sequence[int], packed: Mapping[int, Place], shard_bytes: int) -> int:
        """Write events at the end of a shard until it is as large as it should be; how many."""
        is_new = not shard.exists()
        end = 0 if is_new else max((place.offset + _padded(place.size or 0) for _, place in _members(shard)), default=0)
        count, flushed, batch = 0, end, list[Path]()
        with refusing(shard, "cannot be written"), open(shard, "xb" if is_new else "r+b") as file:
            try:
                for number in numbers:
                    if end >= shard_bytes:
                        break
                    path = self.event_path(number)
                    verify(Place(str(path)))
                    data = path.read_bytes()
                    if number not in packed or read_bytes(packed[number]) != data:  # else it was about to be removed
                        _write_member(file, end, path.name, data)
                        end += _TAR + _padded(len(data))
                    count += 1
                    batch.append(path)
                    if end - flushed >= _BATCH:
                        _flush(file, end, batch)
                        flushed, batch = end, []
            finally:
                file.truncate(end)  # of a member that did not become whole
                _flush(file, end, batch)
        return count

    def unpack(self, progress: Progress | None = None, shards: Collection[Path] | None = None) -> int:
        """Give each event of the shards, or of some of them, a file of its own again, and remove these; how many.

        Damaged events are left out: a `check` finds them missing. `InputError` where a file cannot be written.
        """
        shards = self.shard_paths() if shards is None else shards
        if not shards:
            return 0
        with locked(self.shards / LOCK, f"{self.shards}: another work is packing this set; wait for its end"):
            packed = [(n, place) for n, place in self.places().items() if Path(place.path) in shards]
            for done, (number, place) in enumerate(packed, 1):
                if _is_whole(place):
                    write_bytes(self.event_path(number), read_bytes(place))
                tell(progress, done, len(packed))
            for shard in shards:
                with refusing(shard, "cannot be removed"):
                    shard.unlink()
        return len(packed)


def size_of(place: Place) -> int:
    """Bytes of an event's file, as the disk says."""
    return os.stat(place.path).st_size if place.size is None else place.size


def read_bytes(place: Place) -> bytes:
    """The bytes of an event's file."""
    with refusing(place.path, "cannot be read"), open(place.path, "rb") as file:
        file.seek(place.offset)
        return file.read(-1 if place.size is None else place.size)


def _is_whole(place: Place) -> bool:
    try:
        verify(place)
    except InputError:
        return False
    return True


def _members(shard: Path) -> Iterator[tuple[int, Place]]:
    """The number and the place of each whole event in a shard."""
    with refusing(shard, "cannot be read"), open(shard, "rb", buffering=0) as file:
        at, end = 0, file.seek(0, os.SEEK_END)
        while at + _TAR < end:
            file.seek(at)
            heading = file.read(_TAR)
            name = _EVENT.fullmatch(heading[:100].rstrip(b"\0").decode("latin-1"))
            try:
                size = int(heading[124:135], 8)
            except ValueError:
                return
            if name is None or at + _TAR + size > end:
                return
            yield int(name[1]), Place(str(shard), at + _TAR, size)
            at += _TAR + _padded(size)


def _write_member(file: BinaryIO, at: int, name: str, data: bytes) -> None:
    heading = tarfile.TarInfo(name)  # of no time and nobody
    heading.size = len(data)
    file.seek(at)
    file.write(heading.tobuf(tarfile.USTAR_FORMAT))
    file.write(data.ljust(_padded(len(data)), b"\0"))


def _flush(file: BinaryIO, end: int, written: Sequence[Path]) -> None:
    """Bring a shard to the disk, with the mark of an archive's end, and remove the files that are in it now."""
    file.seek(end)
    file.write(bytes(2 * _TAR))
    file.flush()
    os.fsync(file.fileno())
    for path in written:
        path.unlink(missing_ok=True)


def _padded(size: int) -> int:
    return -(-size // _TAR) * _TAR


def _names(folder: Path) -> list[str]:
    """What is in a folder; nothing where there is none."""
    with refusing(folder, "cannot be read"):
        try:
            return os.listdir(folder)
        except FileNotFoundError:
            return []
