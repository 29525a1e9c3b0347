"""Lazy packages: a public name is imported when it is used for the first time."""

import ast
import contextlib
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
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
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with needing(extra) if extra else contextlib.nullcontext():
            attribute = import_module(f".{modules[name] or name}", package)
        attribute = getattr(attribute, name) if modules[name] else attribute
        setattr(module, name, attribute)
        return attribute

    return import_attribute, lambda: sorted({*vars(module), *modules}), [n for n, source in modules.items() if source]
