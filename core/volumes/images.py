"""Images of line integrals, labelled with the quantity of their volume."""

from typing import Any

import numpy as np

from ..arrays import Array


class Images(np.ndarray):  # type: ignore[type-arg]
    """Line integrals with the `quantity` of their volume, which slices and results of calculations keep.

    Files, tensors and other programs lose the label; images read from them have the quantity "mu".
    """

    @classmethod
    def tag(cls, array: Array, quantity: str) -> "Images":
        """Return a view of `array` as images of a volume of this `quantity`."""
        images = array.view(cls)
        images.quantity = quantity
        return images

    def __array_finalize__(self, source: Any) -> None:
        self.quantity = getattr(source, "quantity", "mu")

    def __array_wrap__(self, array: Any, *context: Any) -> Any:
        return super().__array_wrap__(array, *context) if array.ndim else array[()]  # a sum becomes a plain number
