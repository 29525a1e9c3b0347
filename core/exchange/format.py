"""What an export format is, and how its file or folder is written: completely or not at all."""

import inspect
import os
import shutil
import typing
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import ensure_folder, folder_path


@dataclass(frozen=True)
class Format:
    """A file, or a folder of files, for another program."""

    name: str  # on the command line
    title: str  # what it holds, in one line
    suffixes: tuple[str, ...]  # endings of the file's name, the default first; empty for a folder
    write: Callable[..., None]  # write(system, views, path, **options) writes the file, or fills the empty folder
    options_of: Callable[..., Any] | None = None  # has the options as keyword-only parameters; None: `write` has them

    @property
    def options(self) -> dict[str, tuple[Any, Any]]:
        """Type and default of each option, by name."""
        source = self.options_of or self.write
        types = typing.get_type_hints(source)
        parameters = inspect.signature(source).parameters.values()
        return {p.name: (types[p.name], p.default) for p in parameters if p.kind is p.KEYWORD_ONLY}


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Give a temporary folder beside `path`; rename it to `path` on success, remove it on failure."""
    path = folder_path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: expected a new folder or an empty one")
    temporary = ensure_folder(path.parent) / f".{uuid.uuid4().hex[:8]}-{path.name}"
    try:
        temporary.mkdir()
        yield temporary
        if path.exists():
            path.rmdir()
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
