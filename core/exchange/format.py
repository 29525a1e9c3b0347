"""What a format of geometry is."""

from __future__ import annotations

import inspect
import os
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import ensure_folder, replacing
from ..geometry.system import PinholeSystem
from ..geometry.views import Views


@dataclass(frozen=True)
class Format:
    """A file format, or a folder of files, for another program.

    Attributes
    ----------
    name : str
        What it is called on the command line.
    title : str
        What it is, in one line.
    suffixes : tuple of str
        Endings of the file's name, the first being the default; empty for a folder.
    write : callable
        ``write(system, views, path, **options)`` writes the file, or into the existing empty folder; options have
        defaults. Raises `InputError` for what the format cannot express.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    write: Callable[..., None]

    @property
    def options(self) -> dict[str, inspect.Parameter]:
        """The options of `write`, by name."""
        return dict(list(inspect.signature(self.write).parameters.items())[3:])

    def write_whole(
        self, system: PinholeSystem, views: Views, path: str | os.PathLike[str], options: dict[str, Any]
    ) -> None:
        """Write so that all of it is there or nothing."""
        path = Path(path)
        unknown = set(options) - set(self.options)
        if unknown:
            raise InputError(
                f"format {self.name}: no option {sorted(unknown)[0]!r}, it has {', '.join(self.options) or 'none'}"
            )
        if self.suffixes:
            if not path.name.lower().endswith(self.suffixes):
                raise InputError(f"{path}: expected a name ending in {', '.join(self.suffixes)}")
            with replacing(path) as temporary:
                self.write(system, views, temporary, **options)
            return
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path}: expected a new folder or an empty one")
        parent = ensure_folder(path.absolute().parent)
        temporary = parent / f".{uuid.uuid4().hex[:8]}-{path.name}"
        try:
            temporary.mkdir()
            self.write(system, views, temporary, **options)
            if path.exists():
                path.rmdir()
            os.replace(temporary, path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
        finally:
            if temporary.exists():
                import shutil

                shutil.rmtree(temporary, ignore_errors=True)
