"""The contents of a volume's file before they become a `Volume`, and helpers that the readers share.

World axes are NIfTI's: +x to the patient's right, +y to the front (anterior), +z to the head (superior), RAS for short.
Those of DICOM and ITK point left, back (posterior) and to the head: LPS.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array, Floats
from ...errors import InputError, warn
from ...geometry.grid import Grid
from ...memory import require
from ...validation import freeze
from ..volume import UNITS, Volume

RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""World mm of DICOM and ITK to ours, on column vectors."""


@dataclass(frozen=True)
class Contents:
    """A file's voxels: values (n_x, n_y, n_z) of any real type, and what the file says about them, or None."""

    array: Array
    affine: Floats | None  # index to world mm, (4, 4)
    quantity: str | None = None
    unit: str | None = None

    def volume(self, quantity: str) -> Volume:
        """The volume, with its values taken as `quantity`."""
        require_voxels(self.array.shape, self.array.dtype)
        if self.affine is None:
            raise InputError("it has no affine: give one (index to world mm, 4 x 4)")
        expected = UNITS.get(self.quantity or quantity)
        if self.unit and expected and self.unit != expected:
            raise InputError(f"its values are in {self.unit}; expected {expected} for {self.quantity or quantity}")
        with np.errstate(over="ignore"):  # what overflows float32 is refused as not finite
            array = np.ascontiguousarray(self.array, np.float32)
        return Volume(freeze(array), Grid(self.array.shape, self.affine), quantity)  # type: ignore[arg-type]


def require_voxels(shape: Sequence[int], kind: np.dtype[Any]) -> None:
    """Refuse an image of `shape` and type `kind` that is not 3-D and real, or does not fit into memory."""
    sizes = " x ".join(map(str, shape)) or "of one value"
    if len(shape) != 3:
        raise InputError(f"expected a 3-D image, got shape {sizes}")
    if min(shape) < 1:
        raise InputError(f"expected at least one voxel along each axis, got {sizes}")
    if kind.kind not in "fiub":
        raise InputError(f"expected real numbers, found {kind}")
    # The file's values, their float32 copy, and the check that they are finite.
    require((4.5 + kind.itemsize) * math.prod(int(n) for n in shape), f"a volume of {sizes} voxels")


def refuse_several_files(field: str, where: str) -> None:
    """Refuse a header whose `field` spreads the voxels over several files."""
    if where.upper().startswith("LIST") or "%" in where:
        raise InputError(f"{field} {where}: voxels in several files are not read; convert them to one")


def warn_of_assumed(path: Path, assumed: Sequence[str]) -> None:
    """Warn of what was `assumed` about the volume's place because the header does not say it, if anything."""
    if assumed:
        warn(f"{path}: it does not say how it lies; taken as: {'; '.join(assumed)}")
