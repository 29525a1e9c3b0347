"""Files: written so that either the whole old or the whole new file exists at any time; and checks of paths."""

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
from typing import TypeVar

from .errors import InputError, expecting, refusing

AnyPath = str | os.PathLike[str]
_P = TypeVar("_P", bound=AnyPath)
_Stamp = tuple[int, int, int]
"""Device, number and time of change of a file: the same under all of its names, another once the file is replaced."""

_TEMPORARY = re.compile(r"\.(?:[0-9a-f]{8}|([0-9a-f]{4})([0-9a-f]{8})[0-9a-f]{8})-(.+)")
"""Name of a temporary file: the host and process that write it, by which leftovers of killed processes are recognised."""
_LEFT_AFTER = 3600  # seconds: another host's temporary file that is untouched for so long is a leftover
_ATTEMPTS = 3
_inputs: set[_Stamp] | None = None  # that the running command has read; None if no command runs
_outputs: dict[str, _Stamp | None] = {}  # that it will write, by their real paths, as they were before
_SAME = "is both an input and an output; choose another name for the output"
_HOST = zlib.crc32(platform.node().encode()) & 0xFFFF


@contextmanager
def keeping_inputs() -> Iterator[None]:
    """Refuse, within the block of a command, to write what the command reads (`note_input`, `note_output`)."""
    global _inputs
    _inputs = set()
    _outputs.clear()
    try:
        yield
    finally:
        _inputs = None


def note_input(path: _P) -> _P:
    """Return `path`, a file that the running command reads; raise `InputError` if the command is to replace it."""
    if _inputs is not None and (stamp := _stamp(path)):
        if stamp in _outputs.values():
            raise InputError(f"{path}: {_SAME}")
        _inputs.add(stamp)
    return path


def note_output(path: AnyPath) -> None:
    """Note that the running command will write a file; raise `InputError` if it reads that, or writes it for another output.

    This is called before the file is written. Later the command may read what it has written.
    """
    if _inputs is not None:
        name, stamp = os.path.realpath(path), _stamp(path)
        if stamp in _inputs:
            raise InputError(f"{path}: {_SAME}")
        if name in _outputs:
            raise InputError(f"{path}: is the name of two outputs; choose another for one of them")
        _outputs[name] = stamp


def _stamp(path: AnyPath) -> _Stamp | None:
    """Return the stamp of an existing file, else None; links are followed."""
    with suppress(OSError, ValueError):
        facts = os.stat(path)
        return facts.st_dev, facts.st_ino, facts.st_mtime_ns
    return None


@contextmanager
def replacing(path: AnyPath) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename the file there to `path` on success, remove it on failure.

    Even if the program is killed or the power fails, either the old or the new file is at `path`. The folder of `path` must
    exist. If `path` is a link, the file that it points to is replaced. The temporary path has the same folder and suffixes,
    and does not exist yet. This serves libraries that write to a path; data in memory are written by `write_bytes`.
    """
    refuse_folder(Path(path).absolute())
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{_HOST:04x}{os.getpid():08x}{os.urandom(4).hex()}-{target.name}")
    with refusing(target, "cannot be written"):
        if not target.parent.is_dir():
            raise InputError(f"{target.parent}: no such folder; make it first or choose another")
        try:
            # The file is created as a test: os.access knows neither read-only disks nor Windows' permissions.
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
    """Write a file whole or not at all, even while other processes write the same file or remove leftovers."""
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            with replacing(path) as temporary:
                temporary.write_bytes(data)
            return
        except InputError as error:
            # The temporary file was removed as a leftover, or on Windows another process is replacing the file just now.
            if attempt == _ATTEMPTS or not isinstance(error.__cause__, FileNotFoundError | PermissionError):
                raise


class Locked(InputError):
    """Refusal of work that another process is doing at the moment."""


@contextmanager
def locked(path: Path, refusal: str) -> Iterator[None]:
    """Hold a lock on the file `path`, which is made if it is missing; raise `Locked(refusal)` if another process holds it.

    The lock ends with the block, or with this process.
    """
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
    """Yield a temporary folder beside `path`; rename it to `path` on success, remove it on failure.

    `path` must be a new folder or an empty one.
    """
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
        except InputError as error:  # the message may name a file in the temporary folder
            raise InputError(str(error).replace(str(temporary), str(path))) from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def final_name(name: str) -> str | None:
    """Return the name that a temporary file of `replacing` gets when it is complete; None for the name of another file."""
    match = _TEMPORARY.fullmatch(name)
    return None if match is None else match[3]


def is_leftover(path: Path) -> bool:
    """Return whether `path` is a temporary file of `replacing` that nobody writes any more.

    A process on this host must have ended; a file of another host must have been untouched for an hour.
    """
    import psutil

    if (match := _TEMPORARY.fullmatch(path.name)) is None or not match[1]:  # earlier versions named no process
        return match is not None
    if int(match[1], 16) == _HOST:
        try:
            return psutil.Process(int(match[2], 16)).status() == psutil.STATUS_ZOMBIE  # killed, and not yet waited for
        except psutil.NoSuchProcess:
            return True
        except psutil.Error:  # another user's process
            return False
    with suppress(OSError):
        return time.time() - path.stat().st_mtime > _LEFT_AFTER
    return False


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files in `folder` that nobody writes any more (`is_leftover`)."""
    for path in filter(is_leftover, folder.glob(".*")):
        path.unlink(missing_ok=True)


def require_file(path: AnyPath, expected: str = "a file", is_input: bool = True) -> Path:
    """Return `path` if it is a file that can be read; refuse a missing file, a folder, a device and a pipe.

    A file that `is_input` is noted (`note_input`). Raises `InputError`, which names what was `expected` in place of a folder
    or device.
    """
    path = Path(path)
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: not a file name (it holds a NUL)")
    with refusing(path, "cannot be read"):
        try:
            mode = path.stat().st_mode
        except FileNotFoundError:
            raise InputError(f"{path}: no such file") from None
        if not stat.S_ISREG(mode):  # reading a pipe would block
            kind = "a folder" if stat.S_ISDIR(mode) else "neither a file nor a folder"
            raise InputError(f"{path}: is {kind}, expected {expected}")
        path.open("rb").close()  # libraries say little about a file that the user may not read
    return note_input(path) if is_input else path


def relative_path(path: AnyPath, folder: AnyPath) -> str:
    """Return a file's path relative to `folder`, with / on every system; the absolute path for a file on another drive."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return Path(path).absolute().as_posix()


def find_ending(path: AnyPath, endings: Sequence[str]) -> str:
    """Return the first of `endings` with which the file's name ends, whatever its case, or "" if none fits."""
    name = Path(path).name.lower()
    return next((ending for ending in endings if name.endswith(ending)), "")


def require_ending(path: AnyPath, endings: Sequence[str]) -> str:
    """Return the first of `endings` with which the file's name ends; raise `InputError` if none fits."""
    if ending := find_ending(path, endings):
        return ending
    raise InputError(f"{path}: expected a name ending in {', '.join(endings)}")


def read_bytes(path: AnyPath) -> bytes:
    """Return all bytes of a file; raise `InputError` if it is none (`require_file`) or cannot be read."""
    with refusing(path, "cannot be read"):
        return require_file(path).read_bytes()


def read_text(path: AnyPath, expected: str = "a text in UTF-8") -> str:
    """Return the text of a UTF-8 file with its line ends unchanged and without a byte order mark.

    Raises `InputError`, which says what was `expected`, if the bytes are no UTF-8.
    """
    with expecting(f"{path}: expected {expected}", UnicodeDecodeError):
        return read_bytes(path).decode("utf-8-sig")


def _to_disk(path: Path) -> None:
    """Flush a file or folder to the disk, so that the new file is whole even if the power fails after the renaming."""
    # Folders can only be opened for reading, and Windows flushes only files that are open for writing.
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_folder(path: Path) -> None:
    """Raise `InputError` if `path` is a folder, a device or a pipe, or cannot be the name of a file."""
    if _is_folder(path):
        raise InputError(f"{path}: is a folder; expected the name of a file to write")
    if path.exists() and not path.is_file():  # a device or pipe would be replaced by the file
        raise InputError(f"{path}: is no file; expected the name of one to write")


def _is_folder(path: Path) -> bool:
    """Return whether `path` is an existing folder; raise `InputError` if it cannot be the name of a file or folder."""
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: not a file name (it holds a NUL)")
    with refusing(repr(str(path)), "not a file name"):  # such as a name that is too long
        return path.is_dir()


def folder_path(path: AnyPath) -> Path:
    """Return the absolute path of a folder, which need not exist; raise `InputError` if it cannot be a folder's name."""
    if not os.fspath(path):
        raise InputError("expected the name of a folder, got an empty one (. is the current folder)")
    folder = Path(path).absolute()
    _is_folder(folder)
    return folder


def ensure_folder(path: AnyPath) -> Path:
    """Make the folder `path` and its parents unless they exist, and return its absolute path.

    Raises `InputError` if the folder cannot be made or written to.
    """
    folder = folder_path(path)
    probe = folder / f".{uuid.uuid4().hex[:8]}"
    with refusing(folder, "cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    return folder
