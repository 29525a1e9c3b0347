"""Files of named arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

SUFFIXES = (".npz", ".json")


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write `arrays` under their names: as NumPy's .npz, or as lists of JSON, whose numbers keep every digit."""
    if path.name.lower().endswith(".json"):
        lists = {name: np.asarray(value).tolist() for name, value in arrays.items()}
        path.write_text(json.dumps(lists, indent=1) + "\n", encoding="utf-8")
        return
    with open(path, "wb") as file:  # by its name, NumPy would add .npz to .NPZ
        np.savez(file, **arrays)
