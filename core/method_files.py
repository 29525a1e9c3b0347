"""Table of the kinds of files that are methods of reconstruction, one row each.

A row is the file's ending and a function that reads it, which imports its library only when it is called. This file stands
above all rooms, so that `reconstruction` needs to know none of them.
"""

from pathlib import Path
from typing import Any

from .reconstruction.method_files import METHOD_FILES


def _read_network(path: Path) -> Any:
    """Return the method of a trained network (.pt); raise `InputError` if torch is missing."""
    from .learning import read_model

    return read_model(path).method


METHOD_FILES[".pt"] = _read_network
