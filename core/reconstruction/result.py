"""Result of a reconstruction."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..arrays import Array, Floats
from ..volumes.volume import Volume

Callback = Callable[[int, Array], bool | None]
"""Called as ``callback(iteration, values)`` after each iteration, counted from 1, with the volume's values, which cannot be
changed; what is true ends the reconstruction. A resumed one counts on."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed volume, and how it came about; as ``start=`` of the same algorithm it goes on where it ended."""

    volume: Volume
    objective: Floats
    """Objective of the method after each iteration (n,); (0,) for a method without one."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The method's name ("method"), its arguments, and why it ended ("stopped"): anything JSON can hold."""
    state: Mapping[str, Array] = field(default_factory=dict)
    """Further arrays, by name, with which the method can go on; most methods need the volume alone."""

    @property
    def iterations(self) -> int:
        """Number of iterations, those before the reconstruction was resumed included."""
        return len(self.objective)


def iterations_text(n: int) -> str:
    """Return a number of iterations in words; "" for 0."""
    return f"{n} iteration{'s' * (n > 1)}" if n else ""
