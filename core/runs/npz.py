"""Runs as numpy archives: the arrays by name, and the attributes as JSON text in `attributes`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from .record import Record

_ATTRIBUTES = "attributes"


def write(record: Record, path: Path) -> None:
    """Write `record` to `path`."""
    contents: dict[str, Any] = {**record.arrays, _ATTRIBUTES: np.array(json.dumps(record.attributes))}
    with open(path, "wb") as file:
        np.savez_compressed(file, **contents)


def read(path: Path) -> Record:
    """Read what `write` wrote."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files if name != _ATTRIBUTES}
        attributes = json.loads(str(file[_ATTRIBUTES])) if _ATTRIBUTES in file.files else {}
    return Record(arrays, attributes)
