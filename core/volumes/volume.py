"""An array on a grid, with the name of what it holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.grid import Grid
from ..validation import freeze, real_array

UNITS = {
    "activity": "kBq/mL",
    "mu": "1/mm",
    "hu": "HU",
    # What a system does in each voxel (core.maps).
    "sensitivity": "counts/decay",
    "modules": "1",
    "resolution": "mm",
    "completeness": "1",
}
"""The unit of each quantity a volume may hold."""

LINE_INTEGRALS = ("activity", "mu")
"""Quantities whose line integrals mean something: kBq/mL mm of activity, and the attenuation along a ray. Those of CT
numbers do not, because air is -1000, nor those of maps."""

_CONVERT = (
    "make mu of its CT numbers first, by hu_to_mu(volume, energy), `mphdrr volume convert FILE --to-mu --energy KEV`, or "
    "CT to Attenuation in Blender's Phantom panel"
)


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxel values on a grid; outside the grid they are 0.

    Attributes
    ----------
    array : float32 array (n_x, n_y, n_z)
        Indexed ``[ix, iy, iz]``, C order, read-only. A read-only float32 C-ordered array is kept as it is,
        any other is copied.
    grid : Grid
        Where the voxels are.
    quantity : str
        ``"activity"`` (kBq/mL), ``"mu"`` (1/mm), ``"hu"``, or another of `UNITS`.

    Raises
    ------
    InputError
        The array's shape is not the grid's, a value is not finite, or the quantity is not known.
    """

    array: NDArray[np.float32]
    grid: Grid
    quantity: str = "activity"

    def __post_init__(self) -> None:
        if not isinstance(self.grid, Grid):
            raise InputError(f"volume: expected a Grid, got {type(self.grid).__name__}")
        if self.quantity not in UNITS:
            raise InputError(f"quantity {self.quantity!r}: expected one of {', '.join(UNITS)}")
        array = self.array
        if not (isinstance(array, np.ndarray) and _is_kept(array) and array.shape == self.grid.shape):
            with np.errstate(over="ignore"):  # what overflows float32 is refused as not finite
                array = freeze(real_array(array, "volume", self.grid.shape, np.float32))
            object.__setattr__(self, "array", array)
        else:
            from ..validation import require_finite

            require_finite(array, "volume")

    @property
    def unit(self) -> str:
        """The unit of the values."""
        return UNITS[self.quantity]


def require_quantity(quantity: str, taken: Sequence[str], name: str) -> None:
    """Raise `InputError` unless `quantity` is one of those that `name` takes; say what becomes of CT numbers."""
    if quantity not in taken:
        advice = f"; {_CONVERT}" if quantity == "hu" and "mu" in taken else ""
        raise InputError(f"{name}: expected a volume of {' or '.join(taken)}, got {quantity}{advice}")


def require_volume(value: object, name: str) -> None:
    """Raise `InputError` unless `value` is a `Volume`; `name` is what needs one."""
    if not isinstance(value, Volume):
        raise InputError(f"{name}: expected a Volume, got {type(value).__name__}")


def _is_kept(array: NDArray[np.float32]) -> bool:
    return array.dtype == np.float32 and array.flags.c_contiguous and not array.flags.writeable
