"""What an export format is."""

import inspect
import typing
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Format:
    """A file, or a folder of files, for another program."""

    name: str  # on the command line
    title: str  # what it holds, in one line
    suffixes: tuple[str, ...]  # endings of the file's name, the default first; empty for a folder
    write: Callable[..., None]  # write(system, views, temporary, **options) writes the file, or fills the empty folder
    options_of: Callable[..., Any] | None = None  # has the options as keyword-only parameters; None: `write` has them

    @property
    def options(self) -> dict[str, tuple[Any, Any]]:
        """Type and default of each option, by name."""
        source = self.options_of or self.write
        types = typing.get_type_hints(source)
        parameters = inspect.signature(source).parameters.values()
        return {p.name: (types[p.name], p.default) for p in parameters if p.kind is p.KEYWORD_ONLY}
