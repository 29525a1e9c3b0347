"""Difference of two projection runs: images, numbers and a picture."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats32
from ..errors import InputError
from .display import DIVERGING, Display, unit_text
from .mosaic import MosaicSheet, draw_sheet
from .run import ProjectionRun


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of two runs, pixel by pixel: the first minus the second."""

    images: Floats32
    """Differences (M, n_v, n_u)."""
    unit: str
    """Unit of the images."""
    maximum: float
    """Largest absolute difference."""
    rms: float
    """Root mean square of the differences."""
    relative: float
    """`rms` divided by the root mean square of the second run's pixels; infinite if these are all 0."""

    @property
    def text(self) -> str:
        """Maximum, RMS and relative difference in one line."""
        rms = f"rms {self.rms:.4g} {unit_text(self.unit)}".strip()
        return f"maximum {self.maximum:.4g}, {rms}, relative {self.relative:.3%}"


def difference(run: ProjectionRun, other: ProjectionRun) -> Difference:
    """Return `run` minus `other`; raise `InputError` unless modules, pixels and unit are the same."""
    for quality, first, second in (
        ("unit", run.unit, other.unit),
        ("pixels", *("{1} x {0}".format(*r.views.shape) for r in (run, other))),
        ("modules", *(f"{len(r.system)} modules" for r in (run, other))),
    ):
        if first != second:
            raise InputError(f"cannot compare runs of different {quality}: {first}, and {second}")
    if not np.array_equal(run.system.numbers, other.system.numbers):
        raise InputError("cannot compare runs of different modules: their numbers differ")
    differences = run.projections.astype(np.float64) - other.projections
    rms, other_rms = (float(np.sqrt(np.mean(np.square(x, dtype=np.float64)))) for x in (differences, other.projections))
    relative = rms / other_rms if other_rms else (np.inf if rms else 0.0)
    return Difference(differences.astype(np.float32), run.unit, float(np.abs(differences).max()), rms, relative)


def difference_sheet(run: ProjectionRun, result: Difference) -> MosaicSheet:
    """Draw the difference of `run` and another run as a sheet: white where they are equal, red where `run` has more."""
    limit = result.maximum or 1.0
    display = Display(DIVERGING, low=-limit, high=limit)
    return draw_sheet(result.images, run.system.numbers, run.system.rings(), result.unit, display)
