"""What a reconstruction gives."""

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
    """What the method makes as large, or as small, as it can, after each iteration (n,); (0,) of a method without one."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The method's name ("method"), its arguments, and why it ended ("stopped"): anything JSON can hold."""
    state: Mapping[str, Array] = field(default_factory=dict)
    """What else the method needs to go on as if it had not ended, by name; most need the volume alone."""

    @property
    def iterations(self) -> int:
        """How many iterations were done, those before it was resumed included."""
        return len(self.objective)


def iterations_text(n: int) -> str:
    """A number of iterations in words, nothing for 0."""
    return f"{n} iteration{'s' * (n > 1)}" if n else ""
