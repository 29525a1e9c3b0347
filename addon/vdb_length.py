"""Whether an OpenVDB file is cut off: OpenVDB itself reads past a missing end and takes what it finds for values."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

_MAGIC = 0x56444220  # " BDV", OpenVDB's io::OPENVDB_MAGIC
_UUID_CHARACTERS = 36
_LONGEST_TEXT = 1 << 20
_MOST_GRIDS = 10_000


def missing_bytes(path: Path) -> int:
    """How many bytes are missing at a file's end; 0 also where the file's layout does not say.

    OpenVDB's `io::Archive`: a header, the file's metadata, then each grid after a descriptor with the offsets at which its
    parts begin and end.
    """
    length = path.stat().st_size
    with path.open("rb") as file:
        try:
            return max(0, _last_end(file) - length)
        except (struct.error, _OtherLayout):  # OpenVDB itself refuses a file that is cut off in its header
            return 0


class _OtherLayout(Exception):
    pass


def _last_end(file: BinaryIO) -> int:
    magic, _version, _major, _minor, has_offsets = _numbers(file, "qIIIB")
    if magic != _MAGIC or not has_offsets:
        raise _OtherLayout
    file.seek(_UUID_CHARACTERS, 1)
    (count,) = _numbers(file, "I")
    for _ in range(_at_most(count, _MOST_GRIDS)):
        _skip_texts(file, 3)  # name, type and value of metadata, each after its length
    (count,) = _numbers(file, "I")
    end = 0
    for _ in range(_at_most(count, _MOST_GRIDS)):
        _skip_texts(file, 3)  # the grid's name, type and instance parent
        _begin, _blocks, end = _numbers(file, "qqq")
        file.seek(max(end, 0))
    return end


def _numbers(file: BinaryIO, kinds: str) -> tuple[int, ...]:
    size = struct.calcsize(f"<{kinds}")
    return struct.unpack(f"<{kinds}", file.read(size))


def _skip_texts(file: BinaryIO, count: int) -> None:
    for _ in range(count):
        (size,) = _numbers(file, "I")
        file.seek(_at_most(size, _LONGEST_TEXT), 1)


def _at_most(number: int, most: int) -> int:
    if number > most:
        raise _OtherLayout
    return number
