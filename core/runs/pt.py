"""Runs as torch files: ``{"attributes": {...}, "projections": tensor, "geometry/center": tensor, ...}``.

Only tensors, text and whole numbers: ``torch.load(path, weights_only=True)`` reads them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .record import Record

_ATTRIBUTES = "attributes"


def write(record: Record, path: Path) -> None:
    """Write `record` to `path`."""
    torch = _torch()
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in record.arrays.items()}
    torch.save({_ATTRIBUTES: record.attributes, **tensors}, path)


def read(path: Path) -> Record:
    """Read what `write` wrote."""
    content = _torch().load(path, weights_only=True, map_location="cpu")
    attributes = content.pop(_ATTRIBUTES, {})
    return Record({name: tensor.numpy() for name, tensor in content.items()}, attributes)


def _torch() -> Any:
    try:
        import torch
    except ImportError:
        raise InputError(
            ".pt files need torch, which is not installed: pip install torch, or use .h5 or .npz"
        ) from None
    return torch
