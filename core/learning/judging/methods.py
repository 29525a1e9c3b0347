"""Methods that are judged, and the baselines among them, which are tuned on validation data alone."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

_FIRST, _BEST = 10, 3  # events that all choices are compared on, and choices that are compared on all events
_FWHM = 2.3548  # of a Gaussian, in its standard deviations


@dataclass(frozen=True)
class JudgedMethod:
    """A method by name: a function of a run that gives its volume, on the judge's grid."""

    name: str
    function: Callable[[ProjectionRun], Volume]
    fingerprint: str
    """Another one for a method that may give another volume, such as the hash of a model's file."""
    trained_on: Mapping[str, list[int]] = field(default_factory=dict)
    """The events that it has seen, as `sets.events_by_recipe` gives them."""
    saved: Callable[[], float] = float
    """Seconds that its last volume would have taken more, had another method not left what both need."""


@dataclass(frozen=True)
class Family:
    """Baselines of one kind, of which tuning chooses one: by `reconstruct_run`, with the model that made the run.

    The choices are of OSEM an iteration at which it ends and the width of a Gaussian filter, mm; of BSREM, whose prior has
    relative differences, the prior's weight.
    """

    name: str  # "osem" or "bsrem"
    grid: Grid
    iterations: int
    subsets: int
    choices: tuple[tuple[float, ...], ...]

    @property
    def record(self) -> dict[str, Any]:
        """All that the volumes depend on, as JSON holds it."""
        return {**vars(self), "grid": [list(self.grid.shape), self.grid.affine.tolist()]}

    def volumes(self, run: ProjectionRun, threads: int | None = None) -> Iterator[Volume]:
        """The volume of each choice; one run of OSEM gives all of its own."""
        if self.name == "bsrem":
            for (weight,) in self.choices:
                yield reconstruct_run(run, self._recipe(threads, prior="relative-difference", weight=weight)).volume
            return
        found: dict[int, NDArray[Any]] = {}

        def watch(iteration: int, values: NDArray[Any], _: Sequence[float]) -> None:
            if any(iteration == stop for stop, _ in self.choices):
                found[iteration] = np.array(values)

        reconstruct_run(run, self._recipe(threads), watch=watch)
        for stop, width in self.choices:
            yield Volume(smoothed(found[int(stop)], self.grid, width), self.grid, "activity")

    def method(self, choice: Sequence[float]) -> JudgedMethod:
        """The method of a choice."""
        iterations = int(choice[0]) if self.name == "osem" else self.iterations
        only = replace(self, choices=(tuple(choice),), iterations=iterations)
        last = f"{choice[-1]:g} mm" if self.name == "osem" else f"weight {choice[-1]:g}"
        name = f"{self.name} {iterations} x {self.subsets}, {last}"
        return JudgedMethod(name, lambda run: next(only.volumes(run)), short_hash(only.record))

    def _recipe(self, threads: int | None, **settings: Any) -> Recipe:
        given = {"voxels": self.grid.shape, "spacing": self.grid.spacing.tolist(), "center": self.grid.center.tolist()}
        given |= {"method": self.name, "iterations": self.iterations, "subsets": self.subsets, **settings}
        own = {} if threads is None else {"compute.threads": threads}
        return Recipe(own | {f"reconstruction.{key}": value for key, value in given.items()})


def smoothed(values: NDArray[Any], grid: Grid, width: float) -> NDArray[np.float32]:
    """Voxels after a Gaussian filter of `width` mm, full width at half maximum; beyond the edges nothing is."""
    found = np.asarray(values, np.float32)
    for axis, (n, spacing) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        if width:
            blur = gaussian_blur(n, width / _FWHM / float(spacing)).astype(np.float32)
            found = np.moveaxis(np.tensordot(blur, found, (1, axis)), 0, axis)
    return np.ascontiguousarray(found)


def tuned(family: Family, cases: Iterable[Case], progress: Progress | None = None) -> dict[str, Any]:
    """The choice of a family with the least mean NRMSE over events, and that of all others, as JSON holds them.

    Choices that cost a reconstruction each are compared on the first events, the best of them on all. Several events are
    worked on at once. `progress` is called as ``progress(events done, 0)``.
    """
    others, kept, errors = iter(cases), family, np.empty((0, len(family.choices)))
    for some in (islice(others, _FIRST), others):

        def of(case: Case, family: Family = kept) -> list[float]:
            return [nrmse(volume, case.truth) for volume in family.volumes(case.run, threads=1)]

        for found in in_order(of, some, thread_count(None)):
            known = dict(zip(kept.choices, found, strict=True))
            errors = np.vstack([errors, [known.get(choice, np.nan) for choice in family.choices]])
            tell(progress, len(errors), 0)
        means = np.nanmean(errors, axis=0)
        if family.name == "bsrem":
            kept = replace(family, choices=tuple(family.choices[i] for i in sorted(np.argsort(means)[:_BEST])))
    least, choice = min((float(mean), c) for c, mean in zip(family.choices, means, strict=True) if c in kept.choices)
    rows = [[*choice, mean] for choice, mean in zip(family.choices, means.tolist(), strict=True)]
    return {"choice": list(choice), "nrmse": least, "events": len(errors), "all": rows}
