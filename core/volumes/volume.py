"""A volume: an array on a grid, and the quantity that it holds."""

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
    "backprojection": "images' unit",  # of what views say together (core.perspective.backprojection)
}
"""The quantities that a volume may hold, and their units."""

AIR_HU = -1000.0
"""CT number of air."""

LINE_INTEGRALS = ("activity", "mu")
"""Quantities whose line integrals have a meaning. CT numbers have none, because air is -1000, nor have maps."""

CONVERT = (
    "; convert its CT numbers first: hu_to_mu(volume, energy), `mphdrr volume convert FILE --to-mu --energy KEV`, or "
    "CT to Attenuation in Blender's Phantom panel"
)


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxel values on a grid. Outside the grid they are 0.

    The float32 `array` (n_x, n_y, n_z) is read-only, in C order, and indexed ``[ix, iy, iz]``; one that is so already is
    kept, any other is copied. The `quantity` is ``"activity"`` (kBq/mL), ``"mu"`` (1/mm), ``"hu"``, or another of
    `UNITS`.
    """

    array: Floats32
    grid: Grid
    quantity: str = "activity"
    note: str = ""
    """What who sees it should know, such as that a network made it: files that are written of it say so."""

    def __post_init__(self) -> None:
        instance(self.grid, Grid, "grid")
        one_of(self.quantity, UNITS, "quantity")
        given = real_numbers(self.array, "volume")
        fits = (given.dtype, given.shape) == (np.float32, self.grid.shape)
        if fits and given.flags.c_contiguous and not given.flags.writeable:
            require_finite(given, "volume")
        else:
            given = freeze(real_array(given, "volume", self.grid.shape, np.float32))
        object.__setattr__(self, "array", given)

    @property
    def unit(self) -> str:
        """The unit of the values."""
        return UNITS[self.quantity]


def require_quantity(quantity: str, taken: Sequence[str], name: str) -> None:
    """Refuse a `quantity` that is none of those `taken` by `name`; for CT numbers the message says how to convert them."""
    if quantity not in taken:
        advice = CONVERT if quantity == "hu" and "mu" in taken else ""
        raise InputError(f"{name}: expected a volume of {' or '.join(taken)}, got {quantity}{advice}")


def outside_value(volume: Volume) -> float:
    """Default value outside the grid when a volume is resampled or padded: -1000 for CT numbers, else 0."""
    return AIR_HU if volume.quantity == "hu" else 0.0
