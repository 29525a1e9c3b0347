"""Subject of a figure: a scanner, a volume, a run, and how they are to be shown."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..arrays import Floats
from ..errors import InputError
from ..geometry.collimator import Construction
from ..geometry.scanner import Scanner
from ..geometry.system import AnyScanner, chosen_modules
from ..runs.display import Display
from ..volumes.volume import Volume

if TYPE_CHECKING:
    from ..runs.run import ProjectionRun

NEEDS = ("scanner", "volume", "run")
"""Fields of `FigureSubject` that a figure may need."""


def require(needs: Sequence[str], available: Container[str], figure: str, missing: Mapping[str, str]) -> None:
    """Raise `InputError` if a need of a figure is not among those at hand; `missing` holds the advice for each need."""
    for need in needs:
        if need not in available:
            raise InputError(f"figure {figure}: {missing[need]}")


@dataclass(frozen=True, eq=False)
class FigureSubject:
    """Scanner, volume and projections of a figure; those that are not at hand are None."""

    scanner: Scanner | None = None
    construction: Construction = field(default_factory=Construction)
    """Construction of the scanner's collimators."""
    volume: Volume | None = None
    run: "ProjectionRun | None" = None
    name: str = ""
    """Name of the volume."""
    pose: Floats | None = None
    """World-from-phantom transform (4, 4), mm, if the volume is a phantom."""
    display: Display = field(default_factory=Display)
    """Colours and scale of projections."""
    modules: str | None = None
    """Numbers of the modules to show, such as "1-40" or "1-20,41"; None for all."""

    def select_modules(self, system: AnyScanner) -> AnyScanner:
        """Return the modules of `system` that the figure shows."""
        return chosen_modules(system, self.modules)
