"""Images that know what they are of."""

from typing import Any

import numpy as np

from ..arrays import Array


class Images(np.ndarray):  # type: ignore[type-arg]
    """Line integrals that know of which quantity they are, as do parts of them and what is calculated from them.

    Files, tensors and other programs do not; read again, they are of "mu".
    """

    @classmethod
    def of(cls, array: Array, quantity: str) -> "Images":
        """The same numbers, of a volume's quantity."""
        images = array.view(cls)
        images.quantity = quantity
        return images

    def __array_finalize__(self, source: Any) -> None:
        self.quantity = getattr(source, "quantity", "mu")

    def __array_wrap__(self, array: Any, *more: Any) -> Any:
        return super().__array_wrap__(array, *more) if array.ndim else array[()]  # sums are numbers
