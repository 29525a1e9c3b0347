"""Result of an iterative reconstruction: the volume, the objective of each iteration, and the state for a resume."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..arrays import Array, Floats
from ..volumes.volume import Volume

Callback = Callable[[int, Array], bool | None]
"""Function that is called as ``callback(iteration, values)`` after each iteration; returning a true value ends the work.

`iteration` counts from 1, iterations before a resume included; `values` are the volume's values, read-only.
"""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Reconstructed volume with its history; as the argument ``start`` of the same method it is resumed."""

    volume: Volume
    """Reconstructed volume."""
    objective: Floats
    """Function that the method maximises or minimises, after each iteration (n,); (0,) for a method without one."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Method's name ("method"), its arguments, and the reason for its end ("stopped"), in types that JSON can hold."""
    state: Mapping[str, Array] = field(default_factory=dict)
    """Arrays by name that the method needs besides the volume to be resumed; empty for most methods."""

    @property
    def iterations(self) -> int:
        """Number of finished iterations, those before a resume included."""
        return len(self.objective)


def iterations_text(n: int) -> str:
    """Return a number of iterations as text, such as "3 iterations"; "" for 0."""
    return f"{n} iteration{'s' * (n > 1)}" if n else ""
