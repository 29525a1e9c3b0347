"""SciPy's solvers, imported when they are asked for: an extra, which no other file needs."""

from importlib import import_module
from typing import Any

from ..errors import needing


def scipy_module(name: str) -> Any:
    """``scipy.<name>``, such as "optimize". Raises InputError where SciPy is missing."""
    with needing("mphdrr[design]"):
        return import_module(f"scipy.{name}")
