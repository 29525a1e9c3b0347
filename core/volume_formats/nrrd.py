"""NRRD, by pynrrd."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .contents import Contents, first_line, require_voxels

# The signs that turn a space's axes into right, anterior, superior. A space without a name is taken as that.
_SPACES = {
    None: (1, 1, 1),
    "right-anterior-superior": (1, 1, 1),
    "ras": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1),
    "las": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1),
    "lps": (-1, -1, 1),
    "3d-right-handed": (1, 1, 1),
}
_MILLIMETRES = {"mm": 1.0, "millimeter": 1.0, "millimeters": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "µm": 0.001}


def read(path: Path) -> Contents:
    """Read .nrrd, or .nhdr and the file beside it."""
    import nrrd

    header = nrrd.read_header(str(path))
    for name in ("type", "sizes"):
        if name not in header:
            raise InputError(f"it has no field {name}: it is damaged or ends early")
    kind = header["type"]
    if kind == "block":
        raise InputError("expected real numbers, found blocks of bytes")
    require_voxels(header["sizes"], np.dtype(np.float64 if kind == "double" else np.float32))
    affine = _affine(header)
    try:
        array, _ = nrrd.read(str(path))
    except Exception as error:  # of what is not there, pynrrd says little or nothing
        sizes = " x ".join(map(str, header["sizes"]))
        raise InputError(f"its data are damaged or end early; expected {sizes} voxels ({first_line(error)})") from error
    return Contents(array, affine, header.get("quantity"), header.get("unit"))


def write(volume: Volume, path: Path) -> None:
    """Write .nrrd with the exact affine."""
    import nrrd

    affine = volume.grid.affine
    header = {
        "space": "right-anterior-superior",
        "space directions": affine[:3, :3].T,
        "space origin": affine[:3, 3],
        "space units": ["mm"] * 3,
        "encoding": "gzip",
        "quantity": volume.quantity,
        "unit": volume.unit,
    }
    nrrd.write(str(path), volume.array, header, compression_level=1)


def _affine(header: dict[str, Any]) -> np.ndarray:
    space = header.get("space")
    name = None if space is None else space.lower()
    if name not in _SPACES:
        raise InputError(
            f"space {space!r}: expected right-anterior-superior, left-posterior-superior or another of 3-D"
        )
    affine = np.eye(4)
    if "space directions" in header:
        affine[:3, :3] = np.asarray(header["space directions"], np.float64).T
    else:
        spacings = np.asarray(header.get("spacings", [1.0] * 3), np.float64)
        affine[:3, :3] = np.diag(np.where(np.isfinite(spacings), spacings, 1.0))
    affine[:3, 3] = header.get("space origin", [0.0] * 3)
    units = header.get("space units", ["mm"] * 3)
    if any(unit not in _MILLIMETRES for unit in units):
        raise InputError(f"space units {' '.join(units)}: expected mm, cm, m or um")
    affine[:3] *= np.array([[_MILLIMETRES[unit]] for unit in units])
    return np.diag([*map(float, _SPACES[name]), 1.0]) @ affine
