"""What the tests of field reports share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ..core.conftest import rng, system

__all__ = ["rng", "system"]  # fixtures

_TYPES = {"u": "unsigned integer", "i": "signed integer", "f": "float"}


def write_interfile(path: Path, frames: np.ndarray, *lines: str, kind: str = "<u2") -> Path:
    """Write frames of counts as an Interfile header with these lines, and the numbers beside it."""
    count, rows, columns = frames.shape
    number_type = np.dtype(kind)
    order = "BIGENDIAN" if kind.startswith(">") else "LITTLEENDIAN"
    fields = {
        "name of data file": f"{path.stem}.sin", "total number of images": count, "imagedata byte order": order,
        "number format": _TYPES[number_type.kind], "number of bytes per pixel": number_type.itemsize,
        "matrix size [1]": columns, "matrix size [2]": rows,
    }  # fmt: skip
    head = [f"!{key} := {value}" for key, value in fields.items() if not any(key in line for line in lines)]
    path.write_text("\n".join(["!INTERFILE :=", *head, *lines, "!END OF INTERFILE :="]), encoding="utf-8")
    np.rint(frames).astype(number_type).tofile(path.with_suffix(".sin"))
    return path


@pytest.fixture
def frames(rng: np.random.Generator) -> np.ndarray:
    """Return 24 frames of 6 x 6 whole counts."""
    return rng.poisson(9.0, (24, 6, 6))
