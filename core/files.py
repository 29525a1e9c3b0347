"""Writing files such that the old or the new one is always there, whole."""

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import InputError, refusing


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` on success, remove it on failure.

    Even if the program is killed or the power fails, there is either the old or the new file at `path`, whose folder must
    exist. If `path` is a link, the file it points to is replaced. The temporary path, of the same folder and suffixes, does
    not exist yet.
    """
    refuse_folder(Path(path).absolute())
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError(f"{target.parent}: no such folder; make it first or choose another")
    temporary = target.with_name(f".{uuid.uuid4().hex[:8]}-{target.name}")
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
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


def _to_disk(path: Path) -> None:
    """Flush a file or folder to the disk, so that a power cut after the renaming finds the new file whole."""
    # Folders can only be opened for reading, and Windows flushes only what is open for writing.
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_folder(path: Path) -> None:
    """Raise `InputError` if `path` is a folder or cannot be the name of a file."""
    if _is_folder(path):
        raise InputError(f"{path}: is a folder; expected the name of a file to write")


def _is_folder(path: Path) -> bool:
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: not a file name (it holds a NUL)")
    with refusing(repr(str(path)), "not a file name"):  # such as one that is too long
        return path.is_dir()


def folder_path(path: str | os.PathLike[str]) -> Path:
    """The absolute path of a folder, there or not; `InputError` where it cannot be one's name, such as an empty one."""
    if not os.fspath(path):
        raise InputError("expected the name of a folder, got an empty one (. is the current folder)")
    folder = Path(path).absolute()
    _is_folder(folder)
    return folder


def ensure_folder(path: str | os.PathLike[str]) -> Path:
    """Make the folder `path` and its parents unless they exist; `InputError` if it cannot be made or written to."""
    folder = folder_path(path)
    probe = folder / f".{uuid.uuid4().hex[:8]}"
    with refusing(folder, "cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    return folder
