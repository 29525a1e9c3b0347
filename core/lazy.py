"""Lazy packages, whose public names are imported when they are used for the first time; and old paths of modules."""

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
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package whose ``if TYPE_CHECKING:`` imports its public names.

    Modules that the block imports from the package itself are attributes, too, but not in ``__all__``. `extra` is what pip
    is told to install if an import fails, such as "mphdrr[learning]".
    """
    module = sys.modules[package]
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    modules = {name.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names}

    def import_attribute(name: str) -> Any:
        """Import the module of an attribute at its first use, and return the attribute."""
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with needing(extra) if extra else contextlib.nullcontext():
            attribute = import_module(f".{modules[name] or name}", package)
        attribute = getattr(attribute, name) if modules[name] else attribute
        setattr(module, name, attribute)
        return attribute

    return import_attribute, lambda: sorted({*vars(module), *modules}), [n for n, source in modules.items() if source]


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
