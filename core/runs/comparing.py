"""The difference of two projection runs: images, numbers and a picture."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats32
from ..errors import InputError
from .display import DIVERGING, Display
from .mosaic import Sheet, sheet
from .run import ProjectionRun


@dataclass(frozen=True, eq=False)
class Difference:
    """What one run has more than another."""

    images: Floats32  # (M, n_v, n_u)
    unit: str
    maximum: float  # the largest of all pixels, without its sign
    rms: float  # root mean square of all pixels
    relative: float  # rms as a share of that of the other run's pixels; infinite where those are all 0

    @property
    def text(self) -> str:
        """The numbers in a line."""
        return f"maximum {self.maximum:.4g}, rms {self.rms:.4g} {self.unit}, relative {self.relative:.3%}"


def difference(run: ProjectionRun, other: ProjectionRun) -> Difference:
    """`run` minus `other`, which have to be images of the same modules, pixels and unit."""
    for what, one, two in (
        ("unit", run.unit, other.unit),
        ("pixels", *("{1} x {0}".format(*r.views.shape) for r in (run, other))),
        ("modules", *(f"{len(r.system)} modules" for r in (run, other))),
    ):
        if one != two:
            raise InputError(f"cannot compare runs of different {what}: {one}, and {two}")
    if not np.array_equal(run.system.numbers, other.system.numbers):
        raise InputError("cannot compare runs of different modules: their numbers differ")
    exact = run.projections.astype(np.float64) - other.projections
    rms, of_other = (float(np.sqrt(np.mean(np.square(x, dtype=np.float64)))) for x in (exact, other.projections))
    relative = rms / of_other if of_other else (np.inf if rms else 0.0)
    return Difference(exact.astype(np.float32), run.unit, float(np.abs(exact).max()), rms, relative)


def difference_sheet(run: ProjectionRun, found: Difference) -> Sheet:
    """Draw a difference of `run` as `sheet` draws its images: 0 is white, what `run` has more is red."""
    most = found.maximum or 1.0
    display = Display(DIVERGING, low=-most, high=most)
    return sheet(found.images, run.system.numbers, run.system.rings(), found.unit, display)
