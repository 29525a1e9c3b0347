"""Contents of a volume's file before they become a `Volume`, and checks that the readers share.

World axes are NIfTI's: +x to the patient's right, +y to the front (anterior), +z to the head (superior), RAS for short. The
axes of DICOM and ITK point to the left, to the back (posterior) and to the head: LPS.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array, Floats
from ...errors import InputError, warn
from ...files import require_file
from ...geometry.grid import Grid
from ...memory import require
from ...validation import freeze
from ..volume import UNITS, Volume

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Matrix from the world coordinates of DICOM and ITK to NIfTI's, (4, 4), for column vectors."""


@dataclass(frozen=True)
class VolumeFileContents:
    """Voxels of a volume's file, with the affine, quantity and unit that the file states."""

    array: Array
    """Values (n_x, n_y, n_z) of any real type."""
    affine: Floats | None
    """Affine world-from-index (4, 4), mm, or None."""
    quantity: str | None = None
    """Quantity of the values as stated in the file, or None."""
    unit: str | None = None
    """Unit of the values as stated in the file, or None."""
    is_certain: bool = False
    """Whether the quantity follows from the format's own unit, so that the user cannot mean another one."""

    def to_volume(self, quantity: str) -> Volume:
        """Return the voxels as a `Volume` of `quantity`; raise `InputError` if the file's unit does not fit its quantity."""
        require_voxels(self.array.shape, self.array.dtype)
        if self.affine is None:
            raise InputError("it has no affine: give one (index to world mm, 4 x 4)")
        expected = UNITS.get(self.quantity or quantity)
        if self.unit and expected and self.unit != expected:
            raise InputError(f"its values are in {self.unit}; expected {expected} for {self.quantity or quantity}")
        with np.errstate(over="ignore"):  # `Volume` refuses values that overflow float32, as not finite
            array = np.ascontiguousarray(self.array, np.float32)
        return Volume(freeze(array), Grid(self.array.shape, self.affine), quantity)  # type: ignore[arg-type]


def require_voxels(shape: Sequence[int], dtype: np.dtype[Any], n_held: float = math.inf) -> None:
    """Raise `InputError` unless an image of `shape` and `dtype` is 3-D, of real numbers, and fits into memory.

    It must not have more bytes than `n_held`, the most that the file can hold.
    """
    sizes = " x ".join(map(str, shape)) or "of one value"
    if len(shape) != 3:
        raise InputError(f"expected a 3-D image, got shape {sizes}")
    if min(shape) < 1:
        raise InputError(f"expected at least one voxel along each axis, got {sizes}")
    if dtype.kind not in "fiub":
        raise InputError(f"expected real numbers, found {dtype}")
    n_voxels = math.prod(int(n) for n in shape)
    if dtype.itemsize * n_voxels > n_held:
        raise InputError(f"expected {sizes} voxels of {dtype.itemsize} bytes, the file can hold {n_held:.0f} bytes")
    # Bytes of the file's values, of their float32 copy, and of the check that they are finite.
    require((4.5 + dtype.itemsize) * n_voxels, f"a volume of {sizes} voxels")


def find_data_file(path: Path, field: str, name: str) -> Path:
    """Return the file of numbers whose `name` is in a `field` of the header at `path`.

    It lies in the header's folder or below it. For a name that leads elsewhere, or to nothing, the file of that name beside
    the header is returned, since both may have been moved together. Raises `InputError` if it is none, or several.
    """
    folder = Path(os.path.abspath(path.parent))
    for text in (name, name.replace("\\", "/").rpartition("/")[2]):
        named = Path(os.path.abspath(folder / text))
        if folder in named.parents and (candidate := path.parent / named.relative_to(folder)).exists():
            return require_file(candidate)
    if name.upper().startswith("LIST") or "%" in name:
        raise InputError(f"{field} {name}: voxels in several files are not read; convert them to one")
    raise InputError(f"{field} {name or 'missing'}: its numbers are read from the header's folder, which lacks them")


def warn_of_assumptions(path: Path, assumptions: Sequence[str]) -> None:
    """Warn of the `assumptions` about the volume's position that replace missing fields of the header, if any."""
    if assumptions:
        warn(f"{path}: it does not say how it lies; taken as: {'; '.join(assumptions)}")
