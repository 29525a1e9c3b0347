"""HDF5 files with a seal, which says what every byte of them must be, and the checks of all HDF5 before it is read.

A sealed file begins with 512 bytes of text, HDF5's "user block", which its readers skip: what the file is, how many bytes
of HDF5 follow, and a SHA-256 of this and of the table behind them, which has that of each of their blocks: so a part of the
file can be checked alone.
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
from numpy.typing import NDArray

from .errors import InputError, naming
from .files import require_file
from .memory import require
from .progress import Cancelled

HEADER = 512
"""Bytes of text before the HDF5 data."""
_BLOCK, _DIGEST = 1 << 16, 32
_VERSION = 2
_TEXT = re.compile(rb"(mphDRR [a-zA-Z0-9 ]+) (\d+)\n((?:\w+ \w+\n)*)bytes (\d+)\nsha256 (\w{64})\n\0*")
_PROBE_SECONDS = 60
_PROBE = (  # what hangs HDF5 hangs a process that can be ended
    "import h5py, sys\n"
    "with h5py.File(sys.argv[1], 'r') as file:\n"
    "    file.visititems(lambda _, item: item.id.get_num_chunks() and None if getattr(item, 'chunks', None) else None)\n"
)


class Seal(NamedTuple):
    """The text at the beginning of a sealed file."""

    kind: str  # such as "mphDRR event"
    size: int  # bytes of HDF5
    fields: dict[str, str]
    sha256: str = ""  # of the lines before it and of the table of blocks; in version 1, of the HDF5
    version: int = _VERSION

    @property
    def file_size(self) -> int:
        """Bytes of the whole file."""
        return HEADER + self.size + (0 if self.version == 1 else _DIGEST * -(-self.size // _BLOCK))

    def lines(self, **more: str) -> bytes:
        """The text's lines before the last."""
        lines = {self.kind: self.version, **self.fields, "bytes": self.size, **more}
        return "".join(f"{name} {value}\n" for name, value in lines.items()).encode()

    def text(self) -> bytes:
        """The text, padded to `HEADER` bytes."""
        return self.lines(sha256=self.sha256).ljust(HEADER, b"\0")

    def digest(self, table: bytes) -> str:
        """What `sha256` has to be."""
        return hashlib.sha256(self.lines() + table).hexdigest()


def pack(kind: str, fields: dict[str, str], fill: Callable[[Any], None]) -> memoryview:
    """The bytes of a sealed file, in which `fill` puts what it holds: an ``h5py.File``, open for writing.

    In memory, because HDF5 crashes where a write fails, such as on a full disk.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=HEADER) as file:
        fill(file)
    with memory.getbuffer() as content:
        table = digests(content[HEADER:])
    seal = Seal(kind, memory.seek(0, os.SEEK_END) - HEADER, fields)
    seal = seal._replace(sha256=seal.digest(table))
    memory.write(table)
    memory.seek(0)
    memory.write(seal.text())
    return memory.getbuffer()


def parse_seal(start: bytes) -> Seal | None:
    """The seal that the first `HEADER` bytes of a file are; None where they are none. `InputError` where it is damaged."""
    found = _TEXT.fullmatch(start)
    if found is None:
        if start.startswith(b"mphDRR "):
            raise InputError(f"changed: its first {HEADER} bytes are not as they were written")
        return None
    kind, version, fields, size, sha256 = found.groups()
    if int(version) > _VERSION:
        raise InputError(f"written by a newer mphDRR (format {version.decode()}); update to read it")
    named = dict(line.split(" ") for line in fields.decode().splitlines())
    return Seal(kind.decode(), int(size), named, sha256.decode(), int(version))


def read_seal(file: BinaryIO, offset: int = 0) -> Seal | None:
    """The seal of what begins at `offset` of an open file, as of `parse_seal`."""
    file.seek(offset)
    return parse_seal(file.read(HEADER))


def verify(path: str | os.PathLike[str], offset: int = 0) -> None:
    """Raise `InputError` unless every byte of a sealed file, which begins at `offset`, is as it was written."""
    with open(path, "rb") as file:
        seal = read_seal(file, offset)
        if seal is None:
            raise InputError("it has no seal")
        blocks = _Sealed(file, seal, offset)
        for start in range(0, seal.size, _BLOCK):
            blocks.body(start, min(start + _BLOCK, seal.size))


@contextmanager
def opened(path: str | os.PathLike[str], offset: int = 0) -> Iterator[Any]:
    """An HDF5 file, open for reading: an ``h5py.File`` whose bytes are checked as they are read, where it has a seal.

    `InputError`, which names the file, whatever is wrong with it: it cannot be read, was changed, reads other files
    (external and virtual storage, links), or holds types that are no numbers and no text.
    """
    import h5py

    path = require_file(path)
    with naming(path):
        try:
            with open(path, "rb") as file:
                seal = read_seal(file, offset)
                sealed = None if seal is None else _Sealed(file, seal, offset)
                if sealed is None:
                    _probe(path)
                with h5py.File(path if sealed is None else sealed, "r") as content:
                    _refuse_foreign(content)
                    yield content
        except (InputError, MemoryError, Cancelled):
            raise
        except Exception as error:  # whatever HDF5 raises on a damaged file
            lines = (str(error) or type(error).__name__).splitlines()
            raise InputError(f"cannot be read as HDF5 ({lines[0]})") from error


def numbers(dataset: Any) -> NDArray[Any]:
    """All of a dataset, which has to fit into memory."""
    require(
        math.prod(dataset.shape) * dataset.dtype.itemsize, f"{dataset.name} of {' x '.join(map(str, dataset.shape))}"
    )
    return np.asarray(dataset[()])


class _Sealed(io.RawIOBase):
    """The text and the HDF5 of a sealed file, whose blocks are compared with the table before they are read."""

    def __init__(self, file: BinaryIO, seal: Seal, offset: int) -> None:
        self._file, self._seal, self._start = file, seal, offset + HEADER
        size = file.seek(0, os.SEEK_END) - offset
        if size < seal.file_size:
            raise InputError(f"cut: {size} of {seal.file_size} bytes")
        file.seek(self._start + seal.size)
        self._table = file.read(seal.file_size - HEADER - seal.size) if seal.version > 1 else self._table_of_old()
        if seal.version > 1 and seal.digest(self._table) != seal.sha256:
            raise InputError("changed: its last bytes are not those that were written")
        self._at, self._read, self._from, self._kept = 0, set[int](), 0, b""

    def _table_of_old(self) -> bytes:
        """Of version 1, which has none: made of the content, which is read at once."""
        self._file.seek(self._start)
        content = self._file.read(self._seal.size)
        if hashlib.sha256(content).hexdigest() != self._seal.sha256:
            raise InputError("changed: its bytes are not those that were written")
        return digests(content)

    def body(self, start: int, stop: int) -> bytes:
        """The HDF5's bytes from `start` to `stop`."""
        if not self._from <= start <= stop <= self._from + len(self._kept):
            first, last = start // _BLOCK, -(-stop // _BLOCK)
            self._file.seek(self._start + first * _BLOCK)
            self._kept, self._from = (
                self._file.read(min(last * _BLOCK, self._seal.size) - first * _BLOCK),
                first * _BLOCK,
            )
            for block in set(range(first, last)) - self._read:
                part = self._kept[(block - first) * _BLOCK : (block - first + 1) * _BLOCK]
                if hashlib.sha256(part).digest() != self._table[block * _DIGEST : (block + 1) * _DIGEST]:
                    raise InputError("changed: its bytes are not those that were written")
                self._read.add(block)
        return self._kept[start - self._from : stop - self._from]

    def readable(self) -> bool:
        """Of a raw file."""
        return True

    def seekable(self) -> bool:
        """Of a raw file."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Of a raw file; it ends where the HDF5 does."""
        self._at = offset + (0, self._at, HEADER + self._seal.size)[whence]
        return self._at

    def readinto(self, memory: Any) -> int:
        """Of a raw file."""
        stop = min(self._at + len(memory), HEADER + self._seal.size)
        text = self._seal.text()[self._at : stop]
        data = text + self.body(max(0, self._at - HEADER), stop - HEADER) if stop > HEADER else text
        memory[: len(data)] = data
        self._at += len(data)
        return len(data)


def digests(content: bytes | memoryview) -> bytes:
    """The SHA-256 of each block."""
    return b"".join(hashlib.sha256(content[i : i + _BLOCK]).digest() for i in range(0, len(content), _BLOCK))


def _probe(path: Path) -> None:
    """Raise `InputError` where looking through a file that has no seal crashes HDF5 or does not end."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", _PROBE, str(path)]
    try:
        status = subprocess.run(command, env=environment, capture_output=True, timeout=_PROBE_SECONDS).returncode
    except subprocess.TimeoutExpired:
        raise InputError("damaged: HDF5 finds no end of it") from None
    if status < 0:
        raise InputError("damaged: HDF5 crashes on it")


def _refuse_foreign(file: Any) -> None:
    """Raise `InputError` for what leads out of the file, before any data is touched."""
    import h5py

    links: dict[str, Any] = {}
    file.visititems_links(lambda name, link: links.update({name: link}))  # nothing may be raised within
    for name, link in links.items():
        if isinstance(link, h5py.ExternalLink):
            raise InputError(f"{name}: a link to another file, {link.filename!r}, which is not followed")
        if not isinstance(link, h5py.HardLink):  # a soft link leads to what has a name of its own, or nowhere
            continue
        item = h5py.h5o.open(file.id, name.encode())
        if not isinstance(item, h5py.h5d.DatasetID):
            continue
        storage = item.get_create_plist()
        if storage.get_layout() == h5py.h5d.VIRTUAL or storage.get_external_count():
            raise InputError(f"{name}: its numbers are in other files, which are not read")
        kind = item.dtype
        if kind.hasobject and h5py.check_string_dtype(kind) is None:
            raise InputError(f"{name}: expected numbers or text, found objects")
