"""What a figure is of."""

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
"""What a figure may need: fields of `Subject`."""


def require(needs: Sequence[str], have: Container[str], figure: str, missing: Mapping[str, str]) -> None:
    """Refuse a figure that needs what is missing; `missing` says for each need what to do."""
    for need in needs:
        if need not in have:
            raise InputError(f"figure {figure}: {missing[need]}")


@dataclass(frozen=True, eq=False)
class Subject:
    """A scanner, a volume and projections, each only where there is one."""

    scanner: Scanner | None = None
    construction: Construction = field(default_factory=Construction)
    """How the scanner's collimators are built."""
    volume: Volume | None = None
    run: "ProjectionRun | None" = None
    name: str = ""
    """What the volume is called."""
    pose: Floats | None = None
    """World-from-phantom (4, 4), mm, where the volume is a phantom."""
    display: Display = field(default_factory=Display)
    """How projections are shown."""
    modules: str | None = None
    """Which modules, such as "1-40" or "1-20,41"; all where it is None."""

    def chosen(self, system: AnyScanner) -> AnyScanner:
        """The modules of `system` that are to be shown."""
        return chosen_modules(system, self.modules)
