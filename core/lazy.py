"""Packages whose public names are imported when they are first asked for, and old paths of modules."""

import ast
import contextlib
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
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


def deprecated_modules(package: str, new_paths: dict[str, str]) -> None:
    """Keep old module paths importable; each name that is taken from one gives a `DeprecationWarning` with the new path.

    Parameters
    ----------
    package
        The package in which the old modules were.
    new_paths
        Path in `core` by the old path in `package`; a package stands before its modules.
    """
    for old, new in new_paths.items():
        alias = sys.modules[f"{package}.{old}"] = _DeprecatedModule(f"{package}.{old}")
        alias._new_path = f"{__package__}.{new}"
        parent, _, name = alias.__name__.rpartition(".")
        vars(sys.modules[parent]).setdefault("__path__", [])  # ``import parent.name`` asks whether it is a package
        setattr(sys.modules[parent], name, alias)


class _DeprecatedModule(ModuleType):
    """An old path of a module; `_new_path` is its present one."""

    _new_path: str

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        text = f"{self.__name__} is deprecated: import {name} from {self._new_path}"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        module = import_module(self._new_path)
        return getattr(module, name) if hasattr(module, name) else import_module(f"{self._new_path}.{name}")
