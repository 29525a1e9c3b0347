"""Registry of file types that hold a method of reconstruction, such as a trained network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

METHOD_FILES: dict[str, Callable[[Path], Any]] = {}
"""Functions that read a file as a `methods.Method` or raise `InputError`, by file ending in lower case, such as ".pt".

`core/method_files.py` enters the rows of higher layers; it runs when `mphdrr.core` is imported.
"""
