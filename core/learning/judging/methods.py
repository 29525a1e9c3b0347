"""Methods that are judged, and the baselines among them, which are tuned on validation data alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...geometry.grid import Grid
from ...physics.crystal import gaussian_blur
from ...progress import Progress, tell
from ...reconstruction.scores.images import nrmse
from ...runs.recipe import Recipe
from ...runs.reconstructing import reconstruct_run
from ...runs.run import ProjectionRun
from ...volumes.volume import Volume
from .sets import short_hash

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


class Family(Protocol):
    """Baselines of one kind, of which tuning chooses one."""

    @property
    def record(self) -> dict[str, Any]:
        """All that their volumes depend on, as JSON holds it."""

    @property
    def choices(self) -> list[tuple[float, ...]]:
        """What there is to choose from, in the order of `volumes`."""

    def volumes(self, run: ProjectionRun) -> Iterable[Volume]:
        """The volume of each choice."""

    def method(self, choice: Sequence[float]) -> JudgedMethod:
        """The method of a choice."""


@dataclass(frozen=True)
class _Reconstructing:
    """How a family reconstructs: by `reconstruct_run`, with the model that made the run."""

    grid: Grid
    subsets: int

    def recipe(self, method: str, iterations: float, **settings: Any) -> Recipe:
        """A recipe of reconstructions on the grid."""
        n_x, n_y, n_z = self.grid.shape
        given = {"voxels": (n_x, n_y, n_z), "spacing": self.grid.spacing.tolist(), "center": self.grid.center.tolist()}
        given |= {"method": method, "iterations": int(iterations), "subsets": self.subsets, **settings}
        return Recipe({f"reconstruction.{key}": value for key, value in given.items()})

    @cached_property
    def base_record(self) -> dict[str, Any]:
        """The grid and the subsets, as JSON holds them."""
        return {"shape": list(self.grid.shape), "affine": self.grid.affine.tolist(), "subsets": self.subsets}


@dataclass(frozen=True)
class Osem(_Reconstructing):
    """OSEM that ends after one of several iterations, and a Gaussian filter of one of several widths, mm."""

    stops: tuple[int, ...]
    widths: tuple[float, ...]
    name = "osem"

    @property
    def record(self) -> dict[str, Any]:
        """All that their volumes depend on."""
        return {"family": self.name, **self.base_record, "choices": self.choices}

    @property
    def choices(self) -> list[tuple[float, ...]]:
        """Iterations and full width at half maximum, mm."""
        return list(product(self.stops, self.widths))

    def volumes(self, run: ProjectionRun) -> Iterable[Volume]:
        """One reconstruction, whose volumes on the way are filtered."""
        found: dict[int, NDArray[Any]] = {}

        def watch(iteration: int, values: NDArray[Any], _: Sequence[float]) -> None:
            if iteration in self.stops:
                found[iteration] = np.array(values)

        reconstruct_run(run, self.recipe("osem", max(self.stops)), watch=watch)
        for stop, width in self.choices:
            yield Volume(smoothed(found[int(stop)], self.grid, width), self.grid, "activity")

    def method(self, choice: Sequence[float]) -> JudgedMethod:
        """OSEM with a stop and a filter."""
        stop, width = choice
        only = replace(self, stops=(int(stop),), widths=(width,))
        return JudgedMethod(f"osem {stop:g} x {self.subsets}, {width:g} mm", lambda run: next(iter(only.volumes(run))),
                            short_hash(only.record))  # fmt: skip


@dataclass(frozen=True)
class Bsrem(_Reconstructing):
    """BSREM to its end with the relative difference prior of one of several weights."""

    iterations: int
    weights: tuple[float, ...]
    name = "bsrem"

    @property
    def record(self) -> dict[str, Any]:
        """All that their volumes depend on."""
        return {"family": self.name, **self.base_record, "iterations": self.iterations, "choices": self.choices}

    @property
    def choices(self) -> list[tuple[float, ...]]:
        """The prior's weight."""
        return [(weight,) for weight in self.weights]

    def volumes(self, run: ProjectionRun) -> Iterable[Volume]:
        """A reconstruction for each weight."""
        for weight in self.weights:
            recipe = self.recipe("bsrem", self.iterations, prior="relative-difference", weight=weight)
            yield reconstruct_run(run, recipe).volume

    def method(self, choice: Sequence[float]) -> JudgedMethod:
        """BSREM with a weight."""
        only = replace(self, weights=tuple(choice))
        return JudgedMethod(f"bsrem {self.iterations} x {self.subsets}, weight {choice[0]:g}",
                            lambda run: next(iter(only.volumes(run))), short_hash(only.record))  # fmt: skip


def smoothed(values: NDArray[Any], grid: Grid, width: float) -> NDArray[np.float32]:
    """Voxels after a Gaussian filter of `width` mm, full width at half maximum; beyond the edges nothing is."""
    found = np.asarray(values, np.float32)
    for axis, (n, spacing) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        if width:
            blur = gaussian_blur(n, width / _FWHM / float(spacing)).astype(np.float32)
            found = np.moveaxis(np.tensordot(blur, found, (1, axis)), 0, axis)
    return np.ascontiguousarray(found)


def tuned(
    family: Family, cases: Sequence[tuple[ProjectionRun, Volume]], progress: Progress | None = None
) -> dict[str, Any]:
    """The choice of a family with the least mean NRMSE over runs and their truths, and those of all, as JSON holds them."""
    means = np.zeros(len(family.choices))
    for done, (run, truth) in enumerate(cases, 1):
        means += [nrmse(volume, truth) / len(cases) for volume in family.volumes(run)]
        tell(progress, done, len(cases))
    best = int(means.argmin())
    return {"choice": list(family.choices[best]), "nrmse": float(means[best]), "events": len(cases),
            "all": [[*choice, float(mean)] for choice, mean in zip(family.choices, means, strict=True)]}  # fmt: skip
