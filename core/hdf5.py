"""HDF5 files with a seal, a checksum of all their bytes; and checks of any HDF5 file before it is read.

A sealed file begins with 512 bytes of text, HDF5's "user block", which HDF5's readers skip: the file's kind, the number of
bytes of HDF5 that follow, and a SHA-256. The HDF5 is followed by a table with the SHA-256 of each of its blocks, so that a
part of the file can be checked without reading the rest. The SHA-256 in the text is that of the text itself and the table.
"""

import hashlib
import io
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from .arrays import Array
from .errors import InputError, reading, refusing
from .files import AnyPath, require_file
from .memory import require

HEADER = 512
"""Bytes of text before the HDF5 data."""
_BLOCK, _DIGEST = 1 << 16, 32
_CACHED_BLOCKS = 8
"""Number of blocks of an open file that stay in memory, because HDF5 reads the same ones again and again."""
_VERSION = 2
_TEXT = re.compile(rb"(mphDRR [a-zA-Z0-9 ]+) (\d+)\n((?:\w+ \w+\n)*)bytes (\d+)\nsha256 (\w{64})\n\0*")
_PROBE_SECONDS = 30
_PROBE = """
import h5py, sys
from contextlib import suppress
with h5py.File(sys.argv[1], "r") as file:
    def look(name, link):
        with suppress(Exception):
            if isinstance(link, h5py.HardLink):
                item = file[name]
                dict(item.attrs)
                if getattr(item, "chunks", None):
                    item.id.get_num_chunks()
    look("/", h5py.HardLink())
    file.visititems_links(look)
"""
"""Program that looks at all of a file except its numbers, in a process of its own: a damaged file may hang or crash HDF5."""


class Seal(NamedTuple):
    """Text at the beginning of a sealed file."""

    kind: str  # kind of the content, such as "mphDRR event"
    size: int  # number of bytes of HDF5
    fields: dict[str, str]  # further lines of the text, value by name
    sha256: str = ""  # SHA-256 of the text without this line, and of the table of blocks; in version 1, of the HDF5
    version: int = _VERSION

    @property
    def file_size(self) -> int:
        """Number of bytes of the whole file."""
        return HEADER + self.size + (0 if self.version == 1 else _DIGEST * -(-self.size // _BLOCK))

    def text(self) -> bytes:
        """Return the seal as a text, padded with zero bytes to `HEADER` bytes."""
        lines = {self.kind: self.version, **self.fields, "bytes": self.size, "sha256": self.sha256}
        return "".join(f"{name} {value}\n" for name, value in lines.items()).encode().ljust(HEADER, b"\0")

    def signed(self, table: bytes) -> "Seal":
        """Return the seal with its `sha256` filled in: that of the text without it, followed by the `table` of blocks."""
        return self._replace(sha256=hashlib.sha256(self._replace(sha256="").text() + table).hexdigest())


def pack(kind: str, fields: dict[str, str], fill: Callable[[Any], None]) -> memoryview:
    """Return the bytes of a sealed file; `fill` writes its content into an open ``h5py.File``.

    `kind` names the kind of file and `fields` are further texts of the seal, which is read without HDF5. The file is made in
    memory, because HDF5 crashes if a write fails, for example on a full disk.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=HEADER) as file:
        fill(file)
    table = digests(memory.getbuffer()[HEADER:])
    text = Seal(kind, memory.seek(0, os.SEEK_END) - HEADER, fields).signed(table).text()
    assert len(text) == HEADER, "the text is too long"
    memory.write(table)
    memory.seek(0)
    memory.write(text)
    return memory.getbuffer()


def parse_seal(start: bytes) -> Seal | None:
    """Return the seal in the first `HEADER` bytes of a file, or None if the file has none.

    Raises `InputError` if the seal is damaged, or of a newer format.
    """
    if (match := _TEXT.fullmatch(start)) is None:
        if start.startswith(b"mphDRR "):
            raise InputError(f"changed: its first {HEADER} bytes are not as they were written")
        return None
    kind, version, field_lines, size, sha256 = match.groups()
    if int(version) > _VERSION:
        raise InputError(f"written by a newer mphDRR (format {version.decode()}); update to read it")
    fields = dict(line.split(" ") for line in field_lines.decode().splitlines())
    return Seal(kind.decode(), int(size), fields, sha256.decode(), int(version))


def verify(path: AnyPath, offset: int = 0) -> None:
    """Raise `InputError` unless all bytes of the sealed file at byte `offset` of `path` are as they were written."""
    with refusing(path, "cannot be read"), open(path, "rb") as file:
        if (sealed := _sealed(file, offset)) is None:
            raise InputError("it has no seal")
        sealed.check()


@contextmanager
def opened(path: AnyPath, offset: int = 0, *, whole: bool = False) -> Iterator[Any]:
    """Open an HDF5 file that begins at byte `offset` of `path`, and yield it as an ``h5py.File`` for reading.

    The bytes of a sealed file are checked: with `whole` all of them first, else each block when it is read. In the latter
    case HDF5 reads zeros in place of a changed block, and leaving the context raises the error.

    Raises `InputError`, which names the file, if it cannot be read, was changed, refers to other files (external or virtual
    storage, links), or holds data that are neither numbers nor text.
    """
    import h5py

    path = require_file(path)
    with reading(path, "HDF5"), open(path, "rb") as file:
        if (sealed := _sealed(file, offset)) is None:
            if offset:
                raise InputError(f"damaged: nothing of mphDRR begins at its byte {offset}")
            _probe(path)
        elif whole:
            sealed.check()
        try:
            with h5py.File(path if sealed is None or (whole and not offset) else sealed, "r") as content:
                _refuse_foreign(content)
                yield content
        except Exception:  # not kept as a cause: its traceback would hold objects that crash Python when it ends
            if sealed is None or sealed.error is None:
                raise
        if sealed is not None and sealed.error is not None:
            raise sealed.error


def read_numbers(dataset: Any) -> Array:
    """Read all numbers of an open dataset; raise `InputError` unless they, and each chunk of the file, fit into memory."""
    count = max(math.prod(dataset.shape), math.prod(dataset.chunks or ()))
    require(count * dataset.dtype.itemsize, f"{dataset.name} of {' x '.join(map(str, dataset.shape))}")
    return np.asarray(dataset[()])


def datasets(file: Any) -> dict[str, Any]:
    """Return all datasets of an open file by their names, without reading their numbers."""
    import h5py

    items: dict[str, Any] = {}
    file.visititems(lambda name, item: items.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    return items


def attributes(file: Any) -> dict[str, Any]:
    """Read the attributes of an open file: texts, and numbers as Python's own."""
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in file.attrs.items()}


class _Sealed(io.RawIOBase):
    """Raw file of a sealed file's text and HDF5; it compares each block with the table of digests when it is read."""

    def __init__(self, file: BinaryIO, seal: Seal, offset: int) -> None:
        self._file, self._seal, self._start, self._position = file, seal, offset + HEADER, 0
        if (size := file.seek(0, os.SEEK_END) - offset) < seal.file_size:
            raise InputError(f"cut: {size} of {seal.file_size} bytes")
        file.seek(self._start)
        if seal.version == 1:  # without a table of its own: one is made of the content, which is checked as a whole
            content = file.read(seal.size)
            self._table, is_good = digests(content), hashlib.sha256(content).hexdigest() == seal.sha256
        else:
            file.seek(seal.size, os.SEEK_CUR)
            self._table = file.read(seal.file_size - HEADER - seal.size)
            is_good = seal.signed(self._table) == seal
        if not is_good:
            raise InputError("changed: its first or last bytes are not those that were written")
        self._cached: dict[int, bytes] = {}
        self.error: Exception | None = None  # the first error while HDF5 was reading, which then got zeros

    def check(self) -> None:
        """Raise `InputError` unless every block is as it was written."""
        for number in range(len(self._table) // _DIGEST):
            self._block(number)

    def _block(self, number: int) -> bytes:
        """Return block `number` of the HDF5 after comparing it with the table; the last few stay in memory."""
        if number not in self._cached:
            self._file.seek(self._start + number * _BLOCK)
            block = self._file.read(min(_BLOCK, self._seal.size - number * _BLOCK))
            if hashlib.sha256(block).digest() != self._table[number * _DIGEST : (number + 1) * _DIGEST]:
                raise InputError("changed: its bytes are not those that were written")
            if len(self._cached) == _CACHED_BLOCKS:
                del self._cached[next(iter(self._cached))]
            self._cached[number] = block
        return self._cached[number]

    def readable(self) -> bool:
        """Return True: a sealed file can be read."""
        return True

    def seekable(self) -> bool:
        """Return True: a sealed file can be read from any position."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position to `offset` from the start, the present position or the end of the HDF5; return it."""
        self._position = offset + (0, self._position, HEADER + self._seal.size)[whence]
        return self._position

    def readinto(self, memory: Any) -> int:
        """Read bytes from the present position into `memory`; return their number."""
        stop = max(self._position, min(self._position + len(memory), HEADER + self._seal.size))
        content = self._seal.text()[self._position : stop]
        start, end = max(0, self._position - HEADER), stop - HEADER  # positions in the HDF5
        try:
            blocks = b"".join(map(self._block, range(start // _BLOCK, -(-end // _BLOCK))))
            content += blocks[start % _BLOCK :][: max(0, end - start)]
        except Exception as error:  # kept, because h5py would lose it; its traceback would crash Python when it ends
            self.error = self.error or error.with_traceback(None)
            content = content.ljust(stop - self._position, b"\0")
        memory[: len(content)] = content
        self._position += len(content)
        return len(content)


def _sealed(file: BinaryIO, offset: int) -> _Sealed | None:
    """Return the sealed file that begins at byte `offset` of an open file, or None if no seal is there."""
    file.seek(offset)
    seal = parse_seal(file.read(HEADER))
    return None if seal is None else _Sealed(file, seal, offset)


def digests(content: bytes | memoryview) -> bytes:
    """Return the table of digests: the SHA-256 of each block of `content`, joined."""
    return b"".join(hashlib.sha256(content[i : i + _BLOCK]).digest() for i in range(0, len(content), _BLOCK))


def _probe(path: Path) -> None:
    """Raise `InputError` if HDF5 crashes or does not end when it looks through a file without a seal.

    The attempt runs in a process of its own; where none can be started, the file is accepted.
    """
    if "python" not in Path(sys.executable or "").name.lower():  # a program with Python inside, such as Blender
        return
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    window = getattr(subprocess, "CREATE_NO_WINDOW", 0)
    command = [sys.executable, "-P", "-c", _PROBE, str(path.absolute())]
    try:
        status = subprocess.run(
            command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=_PROBE_SECONDS,
            creationflags=window,
        ).returncode  # fmt: skip
    except subprocess.TimeoutExpired:
        raise InputError("damaged: HDF5 finds no end of it") from None
    except OSError:  # the process cannot be started
        return
    if status not in (0, 1):  # 1 is an exception, which reading the file will raise again
        raise InputError("damaged: HDF5 crashes on it")


def _refuse_foreign(file: Any) -> None:
    """Raise `InputError` if an open file refers to other files or holds objects, before any of its data are read."""
    import h5py

    def fault(name: str, link: Any) -> str | None:
        """Return what is wrong with the item `name`, or None; a result other than None ends the visit."""
        if isinstance(link, h5py.ExternalLink):
            return f"{name}: a link to another file, {link.filename!r}, which is not followed"
        if not isinstance(link, h5py.HardLink):  # a soft link leads to an item that is visited itself, or to nothing
            return None
        item = h5py.h5o.open(file.id, name.encode())
        if not isinstance(item, h5py.h5d.DatasetID):
            return None
        storage = item.get_create_plist()
        if storage.get_layout() == h5py.h5d.VIRTUAL or storage.get_external_count():
            return f"{name}: its numbers are in other files, which are not read"
        if item.dtype.hasobject and h5py.check_string_dtype(item.dtype) is None:
            return f"{name}: expected numbers or text, found objects"
        return None

    if (message := file.visititems_links(fault)) is not None:  # h5py would lose an exception that `fault` raises
        raise InputError(message)
