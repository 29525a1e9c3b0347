"""What a reconstruction gives, and when it stops."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..volumes.volume import Volume

Callback = Callable[[int, NDArray[np.floating[Any]]], bool | None]
"""Called as ``callback(iteration, array)`` after each iteration, counted from 1, with the volume's values, which it must not
change; what is true ends the reconstruction."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed volume, and how it came about."""

    volume: Volume
    objective: NDArray[np.float64]
    """After each iteration (n,): what the algorithm makes as large, or as small, as it can."""
    settings: dict[str, Any] = field(default_factory=dict)
    """The algorithm's name and arguments: anything JSON can hold."""

    @property
    def iterations(self) -> int:
        """How many were done."""
        return len(self.objective)
