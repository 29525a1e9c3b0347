"""What one volume of one event is worth: scores by kind of test."""

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
from ...reconstruction.scores.images import nrmse, ssim
from ...runs.reconstructing import model_of
from ...runs.run import ProjectionRun
from ...runs.run_recipe import projector_of_run, recipe_views
from ...volumes.resampling import resample
from ...volumes.volume import Volume
from .consistency import relative_deviance
from .observer import channel_outputs
from .rods import PRESENT, rod_contrasts

Scores = dict[str, Any]
_EVERY = 0.005  # s, between looks at the memory


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One event at one level and draw of noise, as methods are asked for it."""

    event: Event
    run: ProjectionRun
    """With the geometry that methods are told."""
    grid: Grid
    width: float = 30.0
    """Of the observer's channels, mm."""
    defect: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the defect that some events of the test have."""

    @cached_property
    def planned(self) -> PlannedEvent:
        """What the event was made of."""
        return self.event.planned

    @cached_property
    def truth(self) -> Volume:
        """The event's truth on the judge's grid, as means over its voxels."""
        return resample(self.event.truth, self.grid, "mean")

    @cached_property
    def points(self) -> Floats:
        """The middles of the judge's voxels, (n, 3) mm."""
        index = np.indices(self.grid.shape).reshape(3, -1).T
        return moved(self.grid.affine, index)

    @cached_property
    def missing(self) -> list[Floats]:
        """The activity (n,) in `points` that the test's defect takes from the event's heart, and on its other side."""
        whole = dataclasses.replace(_phantom(self, CardiacTorso), defect_severity=0.0)
        angle, values = self.defect["defect_angle_degrees"], whole.values(self.points, self.event.placement)
        turned = ({**self.defect, "defect_angle_degrees": each} for each in (angle, angle % 360 - 180))
        lacking = (dataclasses.replace(whole, **settings) for settings in turned)
        return [(values - each.values(self.points, self.event.placement)).clip(0) for each in lacking]

    @cached_property
    def projector(self) -> Projector:
        """From the judge's grid to the run's images, with the model that made them."""
        return projector_of_run(self.run, self.grid, recipe=model_of(self.run, self.run.recipe))

    def score(self, volume: Volume, scoring: str) -> Scores:
        """The scores of a volume in a test of a kind (`SCORINGS`)."""
        if not same_grid(volume.grid, self.grid):
            raise InputError(f"a method gave {volume.grid.shape} voxels on another grid than the judge's: {self.grid}")
        A = self.projector
        deviance = relative_deviance(self.run.projections, A(volume.array) + A.background)
        found: Scores = {"nrmse": nrmse(volume, self.truth), "deviance": deviance}
        if min(self.grid.shape) >= 11:  # the window's side
            found["ssim"] = ssim(volume, self.truth)
        return found | SCORINGS[scoring](volume, self)

    def contrasts(self, volume: Volume, phantom: DerenzoPhantom, rods: Any) -> Any:
        """`rod_contrasts` of the event's phantom, which it may have mirrored, enlarged and made hotter."""
        found = rod_contrasts(volume, phantom, self.event.placement, rods)
        return found / self.planned.activity_factor


def told(run: ProjectionRun, system: Scanner | None, file: str) -> ProjectionRun:
    """A run whose images are said to be another scanner's, whose workbook is `file`; as it is for None."""
    if system is None:
        return run
    if len(system) != len(run.system):
        raise InputError(f"{file}: expected {len(run.system)} modules, as the events have, got {len(system)}")
    recipe = run.recipe.updated({"system.file": file, "system.modules": None})
    settings = {**run.settings, "recipe": recipe.tables()}
    views = recipe_views(recipe, system)
    return dataclasses.replace(run, system=system, views=views, settings=settings, workbook="", workbook_sha256="")


@contextmanager
def measured() -> Iterator[Scores]:
    """Put into what it gives how long a work took, "seconds", and by how much memory grew for it at most, "megabytes"."""
    import psutil

    found, process, ended = Scores(), psutil.Process(), threading.Event()
    first = most = process.memory_info().rss

    def watch() -> None:
        nonlocal most
        while not ended.wait(_EVERY):
            most = max(most, process.memory_info().rss)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    begun = time.perf_counter()
    try:
        yield found
    finally:
        found["seconds"] = time.perf_counter() - begun
        ended.set()
        watcher.join()
        found["megabytes"] = (max(most, process.memory_info().rss) - first) / 2**20


def _rods(volume: Volume, case: Case) -> Scores:
    """Contrast recovery of all rods, and how many of them are seen."""
    phantom = _phantom(case, DerenzoPhantom)
    contrasts = case.contrasts(volume, phantom, phantom.rods())
    known = contrasts[~np.isnan(contrasts)]
    return {"contrast": float(known.mean()), "rods": len(known), "rods_seen": int((known > PRESENT).sum())}


def _pair(volume: Volume, case: Case) -> Scores:
    """The contrast at the place that was altered, and whether a rod is there."""
    phantom = _phantom(case, DerenzoPhantom)
    site = phantom.altered_site()
    if site is None:
        return {}
    (contrast,) = case.contrasts(volume, phantom, [site])
    return {"site": float(contrast), "site_has_rod": phantom.altered < 0}


def _defect(volume: Volume, case: Case) -> Scores:
    """What the observer's channels see at the defect's place, and its contrast: 1 - its mean by that of the other side."""
    own, other = case.missing
    place = own @ case.points / own.sum()
    shown, true = (
        1 - np.mean(v.array.ravel()[own > own.max() / 2]) / np.mean(v.array.ravel()[other > other.max() / 2])
        for v in (volume, case.truth)
    )
    outputs = channel_outputs(volume, place, case.width).tolist()
    has_defect = _phantom(case, CardiacTorso).defect_severity > 0
    return {"channels": outputs, "defect": has_defect} | ({"contrast": float(shown / true)} if has_defect else {})


def defect_of(events: Any) -> dict[str, Any]:
    """The settings of the one defect that some events of a test have; `InputError` where there is none, or are several."""
    phantoms = [event.planned.phantom for event in events]
    names = [field.name for field in dataclasses.fields(CardiacTorso) if field.name.startswith("defect_")]
    found = [{name: getattr(p, name) for name in names} for p in phantoms if getattr(p, "defect_severity", 0)]
    if not found or any(each != found[0] for each in found):
        raise InputError("scoring defect: expected cardiac torsos, some with one and the same defect")
    return found[0]


def _phantom(case: Case, kind: type[Any]) -> Any:
    phantom = case.planned.phantom
    if not isinstance(phantom, kind):
        raise InputError(f"event {case.event.number}: this scoring is of a {kind.title}, not of {case.event.name}")
    return phantom


SCORINGS: dict[str, Callable[[Volume, Case], Scores]] = {
    "volumes": lambda volume, case: {},
    "rods": _rods,
    "pairs": _pair,
    "defect": _defect,
}
"""What is scored besides the voxels, by kind of test."""
