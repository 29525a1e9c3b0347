"""Numbers and directions in DICOM headers."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError


def numbers(header: Any, name: str, length: int, default: float | None = None) -> NDArray[np.float64]:
    """The `length` finite numbers of the tag `name`, or `default` if it is missing or empty.

    `InputError` names the tag if there is no default or the tag holds something else.
    """
    given = header.get(name)
    value = default if given is None or given == "" else given
    if value is None:
        raise InputError(f"it has no {name}")
    array = np.array(value, np.float64).reshape(-1)
    if len(array) != length or not np.isfinite(array).all():
        raise InputError(f"{name}: expected {length} numbers, got {textwrap.shorten(str(given), 60)}")
    return array


def directions(header: Any) -> NDArray[np.float64]:
    """ImageOrientationPatient as two orthonormal rows (2, 3): along a row of pixels, and down the rows.

    `InputError` if it is missing or does not hold two unit vectors at right angles.
    """
    rows = numbers(header, "ImageOrientationPatient", 6).reshape(2, 3)
    if not np.allclose(rows @ rows.T, np.eye(2), atol=1e-3):
        raise InputError("ImageOrientationPatient: expected two unit vectors at right angles")
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    return left @ right  # the nearest orthonormal rows: the file has few digits
