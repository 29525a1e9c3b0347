"""Scores of one volume of one event, by kind of test."""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np

from ...arrays import Floats
from ...errors import InputError
from ...events.event_set import Event
from ...events.planning import PlannedEvent
from ...geometry.frames import moved
from ...geometry.grid import Grid, same_grid
from ...geometry.scanner import Scanner
from ...phantoms.derenzo import DerenzoPhantom
from ...phantoms.torso import CardiacTorso
from ...projector import Projector
from ...reconstruction.scores.images import nrmse
from ...reconstruction.scores.summary import JUDGED_SCORES
from ...runs.reconstructing import reconstruction_model
from ...runs.run import ProjectionRun
from ...runs.run_recipe import projector_of_run, recipe_views
from ...volumes.resampling import resample
from ...volumes.volume import Volume
from .consistency import relative_deviance
from .observer import channel_outputs
from .rods import PRESENT, rod_contrasts

Scores = dict[str, Any]
_INTERVAL = 0.005  # s between readings of the memory in use


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """Event at one level and noise draw, as methods get it."""

    event: Event
    run: ProjectionRun
    """Run with the geometry that methods are told."""
    grid: Grid
    width: float = 30.0
    """Width of the observer's channels, mm."""
    defect: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the defect that some events of the test have."""

    @cached_property
    def planned(self) -> PlannedEvent:
        """Plan from which the event was made."""
        return self.event.planned

    @cached_property
    def truth(self) -> Volume:
        """Truth of the event on the judge's grid, as means over its voxels."""
        return resample(self.event.truth, self.grid, "mean")

    @cached_property
    def points(self) -> Floats:
        """Centres (n, 3), mm, of the judge's voxels."""
        return moved(self.grid.affine, np.indices(self.grid.shape).reshape(3, -1).T)

    @cached_property
    def missing(self) -> list[Floats]:
        """Activity (n,) in `points` that the defect takes from the heart, and that a defect opposite would take."""
        healthy = dataclasses.replace(_phantom(self, CardiacTorso), defect_severity=0.0)
        angle, values = self.defect["defect_angle_degrees"], healthy.values(self.points, self.event.placement)
        settings_by_side = ({**self.defect, "defect_angle_degrees": side} for side in (angle, angle % 360 - 180))
        torsos = (dataclasses.replace(healthy, **settings) for settings in settings_by_side)
        return [(values - torso.values(self.points, self.event.placement)).clip(0) for torso in torsos]

    @cached_property
    def projector(self) -> Projector:
        """Projector from the judge's grid to the run's images, with the model that made them."""
        return projector_of_run(self.run, self.grid, recipe=reconstruction_model(self.run, self.run.recipe))

    def score(self, volume: Volume, scoring: str) -> Scores:
        """Return the scores of a volume in a test of this kind (`SCORINGS`)."""
        if not same_grid(volume.grid, self.grid):
            raise InputError(f"a method gave {volume.grid.shape} voxels on another grid than the judge's: {self.grid}")
        A = self.projector
        deviance = relative_deviance(self.run.projections, A(volume.array) + A.background)
        scores: Scores = {"nrmse": nrmse(volume, self.truth), "deviance": deviance}
        for row in JUDGED_SCORES:
            if min(self.grid.shape) >= row.judged_from:
                scores[row.name] = row.function(volume, self.truth)
        return scores | SCORINGS[scoring](volume, self)

    def contrasts(self, volume: Volume, phantom: DerenzoPhantom, rods: Any) -> Any:
        """Return `rod_contrasts` for the event's phantom, which may be mirrored, enlarged and hotter than `phantom`."""
        return rod_contrasts(volume, phantom, self.event.placement, rods) / self.planned.activity_factor


def as_believed(run: ProjectionRun, system: Scanner | None, file: str) -> ProjectionRun:
    """Return a run whose images are attributed to another scanner, that of the workbook `file`.

    The run is unchanged if `system` is None. Raises `InputError` for another number of modules.
    """
    if system is None:
        return run
    if len(system) != len(run.system):
        raise InputError(f"{file}: expected {len(run.system)} modules, as the events have, got {len(system)}")
    recipe = run.recipe.updated({"system.file": file, "system.modules": None})
    settings = {**run.settings, "recipe": recipe.tables()}
    views = recipe_views(recipe, system)
    return dataclasses.replace(run, system=system, views=views, settings=settings, workbook="", workbook_sha256="")


@contextmanager
def measure_cost() -> Iterator[Scores]:
    """Yield a dictionary, which gets the duration of the context, "seconds", and its growth of memory, "megabytes"."""
    import psutil

    cost, process, stop = Scores(), psutil.Process(), threading.Event()
    initial = peak = process.memory_info().rss

    def watch() -> None:
        """Keep the largest memory in use until the end."""
        nonlocal peak
        while not stop.wait(_INTERVAL):
            peak = max(peak, process.memory_info().rss)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    start = time.perf_counter()
    try:
        yield cost
    finally:
        cost["seconds"] = time.perf_counter() - start
        stop.set()
        watcher.join()
        cost["megabytes"] = (max(peak, process.memory_info().rss) - initial) / 2**20


def _score_rods(volume: Volume, case: Case) -> Scores:
    """Return the mean contrast recovery of all rods, their number, and the number of rods that are seen."""
    phantom = _phantom(case, DerenzoPhantom)
    contrasts = case.contrasts(volume, phantom, phantom.rods())
    valid = contrasts[~np.isnan(contrasts)]
    return {"contrast": float(valid.mean()), "rods": len(valid), "rods_seen": int((valid > PRESENT).sum())}


def _score_pair(volume: Volume, case: Case) -> Scores:
    """Return the contrast at the altered place, and whether there is a rod."""
    phantom = _phantom(case, DerenzoPhantom)
    if (site := phantom.altered_site()) is None:
        return {}
    (contrast,) = case.contrasts(volume, phantom, [site])
    return {"site": float(contrast), "site_has_rod": phantom.altered < 0}


def _score_defect(volume: Volume, case: Case) -> Scores:
    """Return the outputs of the observer's channels at the defect's place, and the recovery of its contrast.

    The contrast is 1 minus the mean in the defect divided by that on the opposite side.
    """
    lost, opposite = case.missing
    center = lost @ case.points / lost.sum()
    contrast, truth = (
        1 - np.mean(v.array.ravel()[lost > lost.max() / 2]) / np.mean(v.array.ravel()[opposite > opposite.max() / 2])
        for v in (volume, case.truth)
    )
    outputs = channel_outputs(volume, center, case.width).tolist()
    has_defect = _phantom(case, CardiacTorso).defect_severity > 0
    return {"channels": outputs, "defect": has_defect} | ({"contrast": float(contrast / truth)} if has_defect else {})


def common_defect(events: Any) -> dict[str, Any]:
    """Return the settings of the single defect that some events of a test have.

    Raises `InputError` if there is no event with a defect, or if there are several defects.
    """
    phantoms = [event.planned.phantom for event in events]
    names = [field.name for field in dataclasses.fields(CardiacTorso) if field.name.startswith("defect_")]
    defects = [{name: getattr(p, name) for name in names} for p in phantoms if getattr(p, "defect_severity", 0)]
    if not defects or any(defect != defects[0] for defect in defects):
        raise InputError("scoring defect: expected cardiac torsos, some with one and the same defect")
    return defects[0]


def _phantom(case: Case, kind: type[Any]) -> Any:
    """Return the event's phantom; raise `InputError` if it is not of this class."""
    phantom = case.planned.phantom
    if not isinstance(phantom, kind):
        raise InputError(f"event {case.event.number}: this scoring is of a {kind.title}, not of {case.event.name}")
    return phantom


SCORINGS: dict[str, Callable[[Volume, Case], Scores]] = {
    "volumes": lambda volume, case: {},
    "rods": _score_rods,
    "pairs": _score_pair,
    "defect": _score_defect,
}
"""Functions that score volumes besides the voxels, by kind of test."""
