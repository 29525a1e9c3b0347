"""Judged methods, and baselines among them, which are tuned on validation data only."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.grid import Grid
from ...physics.crystal import gaussian_blur
from ...progress import Progress, tell
from ...rays.parallel import in_order, thread_count
from ...reconstruction.scores.images import nrmse
from ...runs.recipe import Recipe
from ...runs.reconstructing import reconstruct_run
from ...runs.run import ProjectionRun
from ...volumes.volume import Volume
from .scoring import Case
from .sets import short_hash

_FIRST, _BEST = 10, 3  # number of events on which all choices are compared, and of choices compared on all events
_FWHM = 2.3548  # full width at half maximum of a Gaussian in standard deviations


@dataclass(frozen=True)
class JudgedMethod:
    """A method with its name: a function from a run to its volume on the judge's grid."""

    name: str
    function: Callable[[ProjectionRun], Volume]
    fingerprint: str
    """Text that differs for methods that may return other volumes, such as the hash of a model's file."""
    trained_on: Mapping[str, list[int]] = field(default_factory=dict)
    """Events of its training, in the form of `sets.events_by_recipe`."""
    saved: Callable[[], float] = float
    """Function that returns the seconds that the last volume saved by sharing another method's intermediate results."""
    truths: Collection[str] = ()
    """Truths of the events of its training, in the form of `sets.truths_of`."""


@dataclass(frozen=True)
class Family:
    """A family of baselines, one of which tuning chooses: by `reconstruct_run`, with the model that made the run.

    A choice of OSEM is the iteration at which it ends and the width of a Gaussian filter, mm. A choice of BSREM, whose prior
    has relative differences, is the prior's weight.
    """

    name: str  # "osem" or "bsrem"
    grid: Grid
    iterations: int
    subsets: int
    choices: tuple[tuple[float, ...], ...]

    @property
    def record(self) -> dict[str, Any]:
        """All data that the volumes depend on, as JSON values."""
        return {**vars(self), "grid": [list(self.grid.shape), self.grid.affine.tolist()]}

    def volumes(self, run: ProjectionRun, threads: int | None = None) -> Iterator[Volume]:
        """Yield the volume of each choice; a single run of OSEM gives those of all its choices."""
        if self.name == "bsrem":
            for (weight,) in self.choices:
                yield reconstruct_run(run, self._recipe(threads, prior="relative-difference", weight=weight)).volume
            return
        volumes_by_iteration: dict[int, NDArray[Any]] = {}

        def keep_volume(iteration: int, values: NDArray[Any], _: Sequence[float]) -> None:
            """Keep the volume of an iteration at which a choice ends."""
            if any(iteration == stop for stop, _ in self.choices):
                volumes_by_iteration[iteration] = np.array(values)

        reconstruct_run(run, self._recipe(threads), watch=keep_volume)
        for stop, width in self.choices:
            yield Volume(smooth(volumes_by_iteration[int(stop)], self.grid, width), self.grid, "activity")

    def method(self, choice: Sequence[float]) -> JudgedMethod:
        """Return the method of one choice."""
        iterations = int(choice[0]) if self.name == "osem" else self.iterations
        family = replace(self, choices=(tuple(choice),), iterations=iterations)
        parameter = f"{choice[-1]:g} mm" if self.name == "osem" else f"weight {choice[-1]:g}"
        name = f"{self.name} {iterations} x {self.subsets}, {parameter}"
        return JudgedMethod(name, lambda run: next(family.volumes(run)), short_hash(family.record))

    def _recipe(self, threads: int | None, **settings: Any) -> Recipe:
        """Return the recipe of a reconstruction with these further settings."""
        values = {"voxels": self.grid.shape, "spacing": self.grid.spacing.tolist(), "center": self.grid.center.tolist()}
        values |= {"method": self.name, "iterations": self.iterations, "subsets": self.subsets, **settings}
        compute = {} if threads is None else {"compute.threads": threads}
        return Recipe(compute | {f"reconstruction.{key}": value for key, value in values.items()})


def smooth(values: NDArray[Any], grid: Grid, width: float) -> NDArray[np.float32]:
    """Filter voxels with a Gaussian of `width` mm, full width at half maximum; values beyond the edges are 0."""
    result = np.asarray(values, np.float32)
    for axis, (n, spacing) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        if width:
            blur = gaussian_blur(n, width / _FWHM / float(spacing)).astype(np.float32)
            result = np.moveaxis(np.tensordot(blur, result, (1, axis)), 0, axis)
    return np.ascontiguousarray(result)


def tune(family: Family, cases: Iterable[Case], progress: Progress | None = None) -> dict[str, Any]:
    """Tune a family: return the choice with the least mean NRMSE over events, and the NRMSE of all choices, as JSON values.

    Choices that need a reconstruction each are compared on the first events, the best of them on all events. Several events
    are processed at once. `progress` is called as ``progress(events done, 0)``.
    """
    remaining, candidates, errors = iter(cases), family, np.empty((0, len(family.choices)))
    for batch in (islice(remaining, _FIRST), remaining):

        def choice_errors(case: Case, family: Family = candidates) -> list[float]:
            """Return the NRMSE of each choice for one event."""
            return [nrmse(volume, case.truth) for volume in family.volumes(case.run, threads=1)]

        for case_errors in in_order(choice_errors, batch, thread_count(None)):
            by_choice = dict(zip(candidates.choices, case_errors, strict=True))
            errors = np.vstack([errors, [by_choice.get(choice, np.nan) for choice in family.choices]])
            tell(progress, len(errors), 0)
        means = np.nanmean(errors, axis=0)
        if family.name == "bsrem":
            candidates = replace(family, choices=tuple(family.choices[i] for i in sorted(np.argsort(means)[:_BEST])))
    least, choice = min((float(m), c) for c, m in zip(family.choices, means, strict=True) if c in candidates.choices)
    rows = [[*choice, mean] for choice, mean in zip(family.choices, means.tolist(), strict=True)]
    return {"choice": list(choice), "nrmse": least, "events": len(errors), "all": rows}
