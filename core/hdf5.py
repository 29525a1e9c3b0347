"""HDF5 files with a seal, which says what every byte of them must be, and the checks of all HDF5 before it is read.

A sealed file begins with 512 bytes of text, HDF5's "user block", which its readers skip: what the file is, how many bytes
of HDF5 follow, and the SHA-256 of the table behind these, which has that of each of their blocks: parts are checked alone.
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
_KEPT = 8
"""Blocks that are kept of an open file: HDF5 reads the same ones again and again."""
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
"""What looks at all of a file but its numbers: what hangs or crashes HDF5 does so to a process that can be ended."""


class Seal(NamedTuple):
    """The text at the beginning of a sealed file."""

    kind: str  # such as "mphDRR event"
    size: int  # bytes of HDF5
    fields: dict[str, str]
    sha256: str = ""  # of this text without it, and the table of blocks; in version 1, of the HDF5
    version: int = _VERSION

    @property
    def file_size(self) -> int:
        """Bytes of the whole file."""
        return HEADER + self.size + (0 if self.version == 1 else _DIGEST * -(-self.size // _BLOCK))

    def text(self) -> bytes:
        """The text, padded to `HEADER` bytes."""
        lines = {self.kind: self.version, **self.fields, "bytes": self.size, "sha256": self.sha256}
        return "".join(f"{name} {value}\n" for name, value in lines.items()).encode().ljust(HEADER, b"\0")

    def signed(self, table: bytes) -> "Seal":
        """The seal with the `sha256` of itself and the `table` of blocks."""
        return self._replace(sha256=hashlib.sha256(self._replace(sha256="").text() + table).hexdigest())


def pack(kind: str, fields: dict[str, str], fill: Callable[[Any], None]) -> memoryview:
    """The bytes of a sealed file, in which `fill` puts what it holds: an ``h5py.File``, open for writing.

    In memory, because HDF5 crashes where a write fails, such as on a full disk.
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


def verify(path: AnyPath, offset: int = 0) -> None:
    """Raise `InputError` unless every byte of a sealed file, which begins at `offset`, is as it was written."""
    with refusing(path, "cannot be read"), open(path, "rb") as file:
        if (sealed := _sealed(file, offset)) is None:
            raise InputError("it has no seal")
        sealed.check()


@contextmanager
def opened(path: AnyPath, offset: int = 0, *, whole: bool = False) -> Iterator[Any]:
    """An HDF5 file, open for reading: an ``h5py.File`` whose bytes are checked as they are read, where it has a seal.

    With `whole`, all are checked before. Else HDF5 reads zeros for what was changed, and leaving the context raises.

    `InputError`, which names the file, whatever is wrong with it: it cannot be read, was changed, reads other files
    (external and virtual storage, links), or holds types that are no numbers and no text.
    """
    import h5py

    path = require_file(path)
    with reading(path, "HDF5"), open(path, "rb") as file:
        sealed = _sealed(file, offset)
        if sealed is None:
            if offset:
                raise InputError(f"damaged: nothing of mphDRR begins at its byte {offset}")
            _probe(path)
        elif whole:
            sealed.check()
        try:
            with h5py.File(path if sealed is None or (whole and not offset) else sealed, "r") as content:
                _refuse_foreign(content)
                yield content
        except Exception:  # dropped here: its traceback keeps what crashes Python when it ends
            if sealed is None or sealed.wrong is None:
                raise
        if sealed is not None and sealed.wrong is not None:
            raise sealed.wrong


def numbers(dataset: Any) -> Array:
    """All of a dataset, which has to fit into memory, as has each of its chunks."""
    count = max(math.prod(dataset.shape), math.prod(dataset.chunks or ()))
    require(count * dataset.dtype.itemsize, f"{dataset.name} of {' x '.join(map(str, dataset.shape))}")
    return np.asarray(dataset[()])


def datasets(file: Any) -> dict[str, Any]:
    """All datasets in an open file, by their names."""
    import h5py

    found: dict[str, Any] = {}
    file.visititems(lambda name, item: found.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    return found


def attributes(file: Any) -> dict[str, Any]:
    """The attributes of an open file: texts, and numbers as Python's own."""
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in file.attrs.items()}


class _Sealed(io.RawIOBase):
    """The text and the HDF5 of a sealed file, whose blocks are compared with the table when they are read."""

    def __init__(self, file: BinaryIO, seal: Seal, offset: int) -> None:
        self._file, self._seal, self._start, self._at = file, seal, offset + HEADER, 0
        size = file.seek(0, os.SEEK_END) - offset
        if size < seal.file_size:
            raise InputError(f"cut: {size} of {seal.file_size} bytes")
        file.seek(self._start)
        if seal.version == 1:  # it has no table: one is made of the content, which is read at once
            content = file.read(seal.size)
            self._table, is_good = digests(content), hashlib.sha256(content).hexdigest() == seal.sha256
        else:
            file.seek(seal.size, os.SEEK_CUR)
            self._table = file.read(seal.file_size - HEADER - seal.size)
            is_good = seal.signed(self._table) == seal
        if not is_good:
            raise InputError("changed: its first or last bytes are not those that were written")
        self._kept: dict[int, bytes] = {}
        self.wrong: Exception | None = None  # found while HDF5 was reading, which then reads zeros

    def check(self) -> None:
        """Raise `InputError` unless every block is as it was written."""
        for block in range(len(self._table) // _DIGEST):
            self._block(block)

    def _block(self, block: int) -> bytes:
        """A block of the HDF5; the last few are kept."""
        if block not in self._kept:
            self._file.seek(self._start + block * _BLOCK)
            part = self._file.read(min(_BLOCK, self._seal.size - block * _BLOCK))
            if hashlib.sha256(part).digest() != self._table[block * _DIGEST : (block + 1) * _DIGEST]:
                raise InputError("changed: its bytes are not those that were written")
            if len(self._kept) == _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[block] = part
        return self._kept[block]

    def readable(self) -> bool:
        """A raw file can be read …"""
        return True

    def seekable(self) -> bool:
        """… at any place."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a place; the file ends where the HDF5 does."""
        self._at = offset + (0, self._at, HEADER + self._seal.size)[whence]
        return self._at

    def readinto(self, memory: Any) -> int:
        """Read on, into memory; how many bytes."""
        stop = max(self._at, min(self._at + len(memory), HEADER + self._seal.size))
        text = self._seal.text()[self._at : stop]
        start, end = max(0, self._at - HEADER), stop - HEADER  # of the HDF5
        try:
            blocks = b"".join(map(self._block, range(start // _BLOCK, -(-end // _BLOCK))))
            text += blocks[start % _BLOCK :][: max(0, end - start)]
        except Exception as error:  # raised here, h5py would lose it; its traceback crashes Python when it ends
            self.wrong = self.wrong or error.with_traceback(None)
            text = text.ljust(stop - self._at, b"\0")
        memory[: len(text)] = text
        self._at += len(text)
        return len(text)


def _sealed(file: BinaryIO, offset: int) -> _Sealed | None:
    file.seek(offset)
    seal = parse_seal(file.read(HEADER))
    return None if seal is None else _Sealed(file, seal, offset)


def digests(content: bytes | memoryview) -> bytes:
    """The SHA-256 of each block."""
    return b"".join(hashlib.sha256(content[i : i + _BLOCK]).digest() for i in range(0, len(content), _BLOCK))


def _probe(path: Path) -> None:
    """Raise `InputError` where looking through a file that has no seal crashes HDF5 or does not end."""
    if "python" not in Path(sys.executable or "").name.lower():  # a program that has Python in it
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
    except OSError:  # it cannot be started
        return
    if status not in (0, 1):  # 1: an error, which is raised here, too
        raise InputError("damaged: HDF5 crashes on it")


def _refuse_foreign(file: Any) -> None:
    """Raise `InputError` for what leads out of the file, before any data is touched."""
    import h5py

    def wrong(name: str, link: Any) -> str | None:
        if isinstance(link, h5py.ExternalLink):
            return f"{name}: a link to another file, {link.filename!r}, which is not followed"
        if not isinstance(link, h5py.HardLink):  # a soft link leads to what has a name of its own, or nowhere
            return None
        item = h5py.h5o.open(file.id, name.encode())
        if not isinstance(item, h5py.h5d.DatasetID):
            return None
        storage = item.get_create_plist()
        if storage.get_layout() == h5py.h5d.VIRTUAL or storage.get_external_count():
            return f"{name}: its numbers are in other files, which are not read"
        kind = item.dtype
        if kind.hasobject and h5py.check_string_dtype(kind) is None:
            return f"{name}: expected numbers or text, found objects"
        return None

    if (found := file.visititems_links(wrong)) is not None:  # h5py loses what is raised there
        raise InputError(found)
