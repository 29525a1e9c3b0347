"""Writing files such that the old or the new one is always there, whole."""

import errno
import os
import platform
import re
import shutil
import stat
import time
import uuid
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import InputError, expecting, refusing

AnyPath = str | os.PathLike[str]

_TEMPORARY = re.compile(r"\.(?:[0-9a-f]{8}|([0-9a-f]{4})([0-9a-f]{8})[0-9a-f]{8})-(.+)")
"""Names of files that are being written: by which host and process, so that what a killed one has left is known."""
_LEFT_AFTER = 3600  # seconds: what other hosts have not touched since is not written any more
_ATTEMPTS = 3
_HOST = zlib.crc32(platform.node().encode()) & 0xFFFF


@contextmanager
def replacing(path: AnyPath) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` on success, remove it on failure.

    Even if the program is killed or the power fails, there is either the old or the new file at `path`, whose folder must
    exist. If `path` is a link, the file it points to is replaced. The temporary path, of the same folder and suffixes, does
    not exist yet. For libraries that write to a path; what is in memory is written by `write_bytes`.
    """
    refuse_folder(Path(path).absolute())
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{_HOST:04x}{os.getpid():08x}{os.urandom(4).hex()}-{target.name}")
    with refusing(target, "cannot be written"):
        if not target.parent.is_dir():
            raise InputError(f"{target.parent}: no such folder; make it first or choose another")
        try:
            # Tried, because os.access knows neither read-only disks nor Windows' permissions.
            with open(temporary, "xb"):
                pass
            temporary.unlink()
            yield temporary
            if target.exists():
                shutil.copymode(target, temporary)
            _to_disk(temporary)
            os.replace(temporary, target)
            with suppress(OSError):  # not possible on Windows and on some file systems
                _to_disk(target.parent)
        finally:
            with suppress(OSError):  # the disk has gone, or Windows lets no file go that a library has left open
                temporary.unlink()


def write_bytes(path: AnyPath, data: bytes | memoryview) -> None:
    """Write a file whole or not at all, also beside others that write it, or remove what they think was left."""
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            with replacing(path) as temporary:
                temporary.write_bytes(data)
            return
        except InputError as error:
            # Its temporary file was removed, or on Windows another is just replacing it.
            if attempt == _ATTEMPTS or not isinstance(error.__cause__, FileNotFoundError | PermissionError):
                raise


class Locked(InputError):
    """Another process is at the same work."""


@contextmanager
def locked(path: Path, refusal: str) -> Iterator[None]:
    """Hold a lock, whose file is made, which ends with this process; `Locked` with `refusal` where another holds it."""
    with refusing(path, "cannot be written"), open(path, "a+b") as file:
        try:
            if os.name == "nt":
                import msvcrt

                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
                raise Locked(refusal) from None
            raise
        yield


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Give a temporary folder beside `path`; rename it to `path`, a new folder or an empty one, or remove it on failure."""
    path = folder_path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: expected a new folder or an empty one")
    temporary = ensure_folder(path.parent) / f".{uuid.uuid4().hex[:8]}-{path.name}"
    with refusing(path, "cannot be written"):
        try:
            temporary.mkdir()
            yield temporary
            if path.exists():
                path.rmdir()
            os.replace(temporary, path)
        except InputError as error:  # of a file in it
            raise InputError(str(error).replace(str(temporary), str(path))) from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def written_name(name: str) -> str | None:
    """The name that a temporary file of `replacing` was to get; None for other files."""
    found = _TEMPORARY.fullmatch(name)
    return None if found is None else found[3]


def is_leftover(path: Path) -> bool:
    """Whether a process that has ended was writing a file, or another host, which has not touched it for an hour."""
    import psutil

    found = _TEMPORARY.fullmatch(path.name)
    if found is None or not found[1]:  # earlier versions named no process
        return found is not None
    if int(found[1], 16) == _HOST:
        try:
            return psutil.Process(int(found[2], 16)).status() == psutil.STATUS_ZOMBIE  # killed, and not yet waited for
        except psutil.NoSuchProcess:
            return True
        except psutil.Error:  # it is another user's
            return False
    with suppress(OSError):
        return time.time() - path.stat().st_mtime > _LEFT_AFTER
    return False


def remove_leftovers(folder: Path) -> None:
    """Remove the files of a folder that were being written by what has ended."""
    for path in filter(is_leftover, folder.glob(".*")):
        path.unlink(missing_ok=True)


def require_file(path: AnyPath, expected: str = "a file") -> Path:
    """A path, if it is that of a file that can be read; `InputError` of what is missing, a folder, device or pipe."""
    path = Path(path)
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: not a file name (it holds a NUL)")
    with refusing(path, "cannot be read"):
        try:
            kind = path.stat().st_mode
        except FileNotFoundError:
            raise InputError(f"{path}: no such file") from None
        if not stat.S_ISREG(kind):  # reading a pipe would block
            found = "a folder" if stat.S_ISDIR(kind) else "neither a file nor a folder"
            raise InputError(f"{path}: is {found}, expected {expected}")
        path.open("rb").close()  # libraries say little about files that they may not read
    return path


def ending_of(path: AnyPath, endings: Sequence[str]) -> str:
    """Which of `endings` the name of a file has, or ""."""
    name = Path(path).name.lower()
    return next((ending for ending in endings if name.endswith(ending)), "")


def require_ending(path: AnyPath, endings: Sequence[str]) -> str:
    """Which of `endings` the name of a file has, or `InputError`."""
    if ending := ending_of(path, endings):
        return ending
    raise InputError(f"{path}: expected a name ending in {', '.join(endings)}")


def read_bytes(path: AnyPath) -> bytes:
    """All of a file; `InputError` where `require_file` gives it, or it cannot be read."""
    with refusing(path, "cannot be read"):
        return require_file(path).read_bytes()


def read_text(path: AnyPath, expected: str = "a text in UTF-8") -> str:
    """The text of a file, every line's end as it is; `InputError` with what is `expected` where it is none in UTF-8."""
    with expecting(f"{path}: expected {expected}", UnicodeDecodeError):
        return read_bytes(path).decode("utf-8-sig")


def _to_disk(path: Path) -> None:
    """Flush a file or folder to the disk, so that a power cut after the renaming finds the new file whole."""
    # Folders can only be opened for reading, and Windows flushes only what is open for writing.
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_folder(path: Path) -> None:
    """Raise `InputError` if `path` is a folder, a device or a pipe, or cannot be the name of a file."""
    if _is_folder(path):
        raise InputError(f"{path}: is a folder; expected the name of a file to write")
    if path.exists() and not path.is_file():  # which would be replaced
        raise InputError(f"{path}: is no file; expected the name of one to write")


def _is_folder(path: Path) -> bool:
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: not a file name (it holds a NUL)")
    with refusing(repr(str(path)), "not a file name"):  # such as one that is too long
        return path.is_dir()


def folder_path(path: AnyPath) -> Path:
    """The absolute path of a folder, there or not; `InputError` where it cannot be one's name, such as an empty one."""
    if not os.fspath(path):
        raise InputError("expected the name of a folder, got an empty one (. is the current folder)")
    folder = Path(path).absolute()
    _is_folder(folder)
    return folder


def ensure_folder(path: AnyPath) -> Path:
    """Make the folder `path` and its parents unless they exist; `InputError` if it cannot be made or written to."""
    folder = folder_path(path)
    probe = folder / f".{uuid.uuid4().hex[:8]}"
    with refusing(folder, "cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    return folder
