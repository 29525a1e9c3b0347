"""Volumes: arrays of voxel values on a grid, with the quantity of the values."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats32
from ..errors import InputError
from ..geometry.grid import Grid
from ..validation import freeze, instance, one_of, real_array, real_numbers, require_finite

UNITS = {
    "activity": "kBq/mL",
    "mu": "1/mm",
    "hu": "HU",
    # Maps of a system's performance (core.physics.maps).
    "sensitivity": "counts/decay",
    "modules": "1",
    "resolution": "mm",
    "completeness": "1",
    "dose_rate": "mGy/h",  # absorbed dose (core.xray.dose)
    "dose": "mGy",
    "backprojection": "images' unit",  # combination of the images of several views (core.perspective.backprojection)
}
"""Units of a volume's values, by quantity."""

AIR_HU = -1000.0
"""CT number of air, HU."""

LINE_INTEGRALS = ("activity", "mu")
"""Quantities with meaningful line integrals: not CT numbers, because air is -1000 HU, and not maps."""

CONVERT = (
    "; convert its CT numbers first: hu_to_mu(volume, energy), `mphdrr volume convert FILE --to-mu --energy KEV`, or "
    "CT to Attenuation in Blender's Phantom panel"
)
"""Advice for messages that refuse a volume of CT numbers."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxel values on a grid; outside the grid the values are 0.

    An array that is float32, read-only and in C order is kept; any other array is copied.
    """

    array: Floats32
    """Values (n_x, n_y, n_z), float32, read-only, indexed ``[ix, iy, iz]``."""
    grid: Grid
    """Grid of the voxels."""
    quantity: str = "activity"
    """Quantity of the values, a key of `UNITS`: ``"activity"`` (kBq/mL), ``"mu"`` (1/mm), ``"hu"``, ..."""
    note: str = ""
    """Note for readers, such as that a network made the volume; it is written into files."""

    def __post_init__(self) -> None:
        instance(self.grid, Grid, "grid")
        one_of(self.quantity, UNITS, "quantity")
        values = real_numbers(self.array, "volume")
        fits = (values.dtype, values.shape) == (np.float32, self.grid.shape)
        if fits and values.flags.c_contiguous and not values.flags.writeable:
            require_finite(values, "volume")
        else:
            values = freeze(real_array(values, "volume", self.grid.shape, np.float32))
        object.__setattr__(self, "array", values)

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return UNITS[self.quantity]


def require_quantity(quantity: str, allowed: Sequence[str], name: str) -> None:
    """Raise `InputError` unless a volume's `quantity` is one of those `allowed`.

    The message begins with `name`, such as a function's; for CT numbers it says how to convert them to mu.
    """
    if quantity not in allowed:
        advice = CONVERT if quantity == "hu" and "mu" in allowed else ""
        raise InputError(f"{name}: expected a volume of {' or '.join(allowed)}, got {quantity}{advice}")


def outside_value(volume: Volume) -> float:
    """Return the default value outside the grid when a volume is resampled or padded: -1000 for CT numbers, else 0."""
    return AIR_HU if volume.quantity == "hu" else 0.0
