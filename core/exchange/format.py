"""Formats of the exported geometry."""

import inspect
import typing
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Format:
    """A format of the geometry for another program: a file, or a folder of files."""

    name: str
    """Name on the command line."""
    title: str
    """Description of the content, in one line."""
    suffixes: tuple[str, ...]
    """Endings of the file's name, the default first; empty for a folder."""
    write: Callable[..., None]
    """Function ``write(system, views, temporary, **options)`` that writes the file, or fills the empty folder."""
    options_source: Callable[..., Any] | None = None
    """Function or class whose keyword-only parameters are the options; None: those of `write`."""

    @property
    def options(self) -> dict[str, tuple[Any, Any]]:
        """The type and the default of each option, by name."""
        source = self.options_source or self.write
        types = typing.get_type_hints(source)
        parameters = inspect.signature(source).parameters.values()
        return {p.name: (types[p.name], p.default) for p in parameters if p.kind is p.KEYWORD_ONLY}
