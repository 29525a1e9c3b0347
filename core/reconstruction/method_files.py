"""Registry of the kinds of files that are methods of reconstruction, such as a trained network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

METHOD_FILES: dict[str, Callable[[Path], Any]] = {}
"""Functions that read a file as a `methods.Method`, by the file's ending in lower case, such as ".pt".

They raise `InputError`. `core/method_files.py` has the rows of the rooms above; it runs when `mphdrr.core` is imported.
"""
