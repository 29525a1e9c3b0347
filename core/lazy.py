"""Packages whose public names are imported when they are first asked for."""

import ast
import contextlib
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from .errors import needing


def public(package: str, extra: str = "") -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package whose ``if TYPE_CHECKING:`` imports its public names.

    Modules of the package itself can be asked for, but are not in ``__all__``. `extra` is what to install
    where an import fails.
    """
    module = sys.modules[package]
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    (block,) = (each for each in tree.body if isinstance(each, ast.If))
    places = {name.name: line.module for line in block.body if isinstance(line, ast.ImportFrom) for name in line.names}

    def getattribute(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with needing(extra) if extra else contextlib.nullcontext():
            found = import_module(f".{places[name] or name}", package)
        found = getattr(found, name) if places[name] else found
        setattr(module, name, found)
        return found

    return getattribute, lambda: sorted({*vars(module), *places}), [name for name, place in places.items() if place]
