"""Write files so that the old one or the new one is there, whole, whatever happens in between."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import InputError


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` on success, remove it on failure.

    Neither killing the program nor a power cut leaves anything but the old file or the new one at `path`. Where that is
    a link, the file it leads to is replaced.

    Parameters
    ----------
    path
        The file to write. Its folder must exist and be writable.

    Yields
    ------
    Path
        A path that does not exist yet, in the same folder and with the same suffixes.

    Raises
    ------
    InputError
        The folder is missing or cannot be written, the path is a folder, or the disk is full.
    """
    refuse_folder(Path(path).absolute())
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise InputError(f"{target.parent}: no such folder; make it first or choose another")
    temporary = target.with_name(f".{uuid.uuid4().hex[:8]}-{target.name}")
    try:
        # Tried here and not by os.access, which does not know of read-only disks or Windows' rights.
        with open(temporary, "xb"):
            pass
        temporary.unlink()
        yield temporary
        if target.exists():
            shutil.copymode(target, temporary)
        _to_disk(temporary)
        os.replace(temporary, target)
        with suppress(OSError):  # Windows opens no folders, some disks don't know the request
            _to_disk(target.parent)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


def _to_disk(path: Path) -> None:
    """Have the system write what it still holds back, so that a power cut after the renaming finds the new file whole."""
    # A folder can only be opened to read; Windows flushes only what is open to write.
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_folder(path: Path) -> None:
    """Raise `InputError` where `path` is a folder or cannot be the name of a file."""
    if "\0" in str(path):
        raise InputError(f"{str(path)!r}: not a file name (it holds a NUL)")
    try:
        is_folder = path.is_dir()
    except OSError as error:  # too long
        raise InputError(f"{str(path)!r}: not a file name ({error.strerror or error})") from error
    if is_folder:
        raise InputError(f"{path}: is a folder; expected the name of a file to write")


def ensure_folder(path: str | os.PathLike[str]) -> Path:
    """Make the folder `path` (and its parents) unless it is there.

    Raises
    ------
    InputError
        It cannot be made, or cannot be written into.
    """
    folder = Path(path).absolute()
    probe = folder / f".{uuid.uuid4().hex[:8]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error})") from error
    return folder
