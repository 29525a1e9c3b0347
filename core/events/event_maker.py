"""The arrays of one event: truth, images of every model, Radon images."""

import math
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from ..arrays import Array, Floats, Floats32
from ..errors import InputError, naming
from ..geometry.grid import Grid
from ..geometry.parallel_views import parallel_views
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..memory import readable_size, require
from ..progress import Progress, tell
from ..projector import Emission, Model, Projector
from ..rays.backends import choose
from ..recording import Remembered, recorded_warnings, remembered
from ..runs.projecting import Imaging, warn_of_energy
from ..runs.recipe import Recipe
from ..runs.run_recipe import mu_of_files, recipe_imaging, recipe_model, recipe_system, recipe_views, require_mu
from ..validation import freeze
from ..volumes.rearranging import centered
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from .planning import PlannedEvent, plan
from .recipe import EventRecipe

_KEPT_VOLUMES = 2
_WORKER = 100 * 2**20  # bytes of a worker's Python and its libraries


@dataclass(frozen=True, eq=False)
class EventArrays:
    """What an event's file holds besides its settings."""

    planned: PlannedEvent
    truth: Volume
    images: dict[str, Floats32]  # by model, (M, n_v, n_u): expected means, background included
    units: dict[str, str]  # by model
    radon: dict[int, Floats32]  # by number of angles, (n, n_v, n_u), value x mm
    gains: Floats  # (M,)
    warnings: tuple[str, ...] = ()  # those of a run of the same settings


class EventMaker:
    """Makes events of a recipe; what all of them share (scanner, rays) is made once.

    `threads` is how many a projection takes, by default one per core. The numbers do not depend on it.
    """

    def __init__(self, recipe: EventRecipe, threads: int | None = None) -> None:
        self.recipe, self.threads = recipe, threads
        self._volumes: dict[str, Remembered[Volume]] = {}

    @cached_property
    def system(self) -> Scanner:
        """The scanner."""
        return recipe_system(self.recipe.system, lambda name: self.recipe.input(name).path)

    @cached_property
    def views(self) -> Views:
        """The views of the scanner's images."""
        return recipe_views(self.recipe.system, self.system)

    @property
    def raw_bytes(self) -> int:
        """How large an event is before it is packed."""
        recipe = self.recipe
        n = recipe.grid.n_voxels + len(recipe.models) * len(self.views) * math.prod(self.views.shape)
        if recipe.radon is not None:
            n += sum(recipe.radon.counts) * math.prod(recipe.radon.shape)
        return 4 * n

    def require_memory(self, workers: int = 1) -> None:
        """Raise `InputError` where so many events at once do not fit into memory, or the scanner cannot be read."""
        what = f"an event of {readable_size(self.raw_bytes)}" if workers == 1 else f"{workers} workers"
        require(workers * (2.5 * self.raw_bytes + (workers > 1) * _WORKER), what)

    def make(self, number: int, progress: Progress | None = None) -> EventArrays:
        """Compute an event; `progress` is called as ``progress(steps done, steps)`` and may raise `Cancelled`."""
        planned, recipe = plan(self.recipe, number), self.recipe
        self.require_memory()
        done, steps = 0, 1 + len(recipe.models) + (0 if recipe.radon is None else len(recipe.radon.counts))

        def step() -> None:
            nonlocal done
            done += 1
            tell(progress, done, steps)

        tell(progress, 0, steps)
        _ = self.system, choose("auto")  # before the event, whose file does not hold warnings of scanner and machine
        with naming(f"event {number}"), recorded_warnings() as warnings:
            truth = self.truth(planned)
            step()
            gains = planned.gains(len(self.system))
            images, units = {}, {}
            for name in recipe.models:
                with naming(name):
                    images[name], units[name] = self._images(name, planned, truth, gains)
                step()
            radon = {}
            for count, projector in self._radon.again().items():
                radon[count] = projector(truth)
                step()
        return EventArrays(planned, truth, images, units, radon, gains, tuple(dict.fromkeys(warnings)))

    def truth(self, planned: PlannedEvent) -> Volume:
        """The event's volume."""
        planned.made_phantom.again()
        factor = planned.activity_factor
        volume = self._voxels(planned, self.recipe.quantity)
        if factor == 1.0:
            return volume
        return Volume(freeze(volume.array * np.float32(factor)), volume.grid, volume.quantity)

    def _voxels(self, planned: PlannedEvent, quantity: str) -> Volume:
        """The mean of the event's phantoms, or its file's volume, on the grid of the truth."""
        grid, placement = self.recipe.grid, planned.placement
        if planned.entry.is_volume:
            file = planned.file if quantity == self.recipe.quantity else planned.mu_file
            assert file is not None  # the recipe refuses attenuation by a volume without a mu_file
            volume = self._read(file)
            if planned.entry["center"] and planned.file is not None:  # what attenuates moves as far as the activity
                volume = centered(volume, volume.grid.center - self._read(planned.file).grid.center)
            return _placed(volume, placement, grid)
        volumes = [phantom.voxelize(grid, placement, quantity=quantity) for phantom in planned.phantoms]
        if len(volumes) == 1:
            return volumes[0]
        mean = sum(volume.array.astype(np.float64) for volume in volumes) / len(volumes)
        return Volume(freeze(np.asarray(mean, np.float32)), grid, quantity)

    def _read(self, file: str) -> Volume:
        """A file's volume; the last few are kept, since events may share them."""
        if file not in self._volumes:
            while len(self._volumes) >= _KEPT_VOLUMES:
                del self._volumes[next(iter(self._volumes))]
            self._volumes[file] = remembered(self.recipe.input(file).volume)
        return self._volumes[file].again()

    def _images(self, name: str, planned: PlannedEvent, truth: Volume, gains: Floats) -> tuple[Floats32, str]:
        """A model's images, and their unit."""
        recipe, imaging, mu = self.recipe.models[name], self._imaging[name].again(), None
        if recipe["attenuation.of_phantom"]:
            self._check_mu(planned, imaging.model)
            mu = self._voxels(planned, "mu").array
        images = imaging.images(truth, mu)
        if isinstance(imaging.model, Emission) and self.recipe["augmentation.module_gain"]:
            images *= gains.astype(np.float32)[:, None, None]
        return images, imaging.unit(truth)

    def _check_mu(self, planned: PlannedEvent, model: Model) -> None:
        """Raise `InputError` where nothing attenuates; warn where it holds at another energy than the model's."""
        if planned.phantom is not None:
            require_mu(planned.phantom, model)
        elif planned.mu_file is not None:
            warn_of_energy(model, planned.entry["energy"], Path(planned.mu_file).name)

    @cached_property
    def _imaging(self) -> dict[str, Remembered[Imaging]]:
        """What makes each model's images."""
        found = {}
        for name, recipe in self.recipe.models.items():
            with naming(f"models.{name}"):
                found[name] = remembered(partial(self._imaging_of, recipe))
        return found

    def _imaging_of(self, recipe: Recipe) -> Imaging:
        grid, placed = self.recipe.grid, self.recipe.placed(recipe)
        mu = mu_of_files(recipe, recipe_model(placed, self.system), lambda file: self.recipe.input(file).volume())
        if recipe["attenuation.of_phantom"]:  # each event has its own: here, to say on which grid
            mu = Volume(freeze(np.zeros(grid.shape, np.float32)), grid, "mu")
        return recipe_imaging(placed, self.system, self.views, grid, mu, threads=self.threads)

    @cached_property
    def _radon(self) -> Remembered[dict[int, Projector]]:
        recipe, counts = self.recipe, () if self.recipe.radon is None else self.recipe.radon.counts
        projector = partial(Projector, recipe.grid, threads=self.threads)
        return remembered(lambda: {n: projector(radon_views(recipe, n)) for n in counts})


def radon_views(recipe: EventRecipe, count: int) -> Views:
    """The parallel views of a recipe with so many angles."""
    if recipe.radon is None or count not in recipe.radon.counts:
        known = () if recipe.radon is None else recipe.radon.counts
        raise InputError(f"radon: no images of {count} angles; there are {', '.join(map(str, known)) or 'none'}")
    angles = math.radians(recipe.radon.degrees) / count * np.arange(count)
    return parallel_views(angles, recipe.radon.shape, recipe.radon.pitch, center=recipe.grid.center)


def _placed(volume: Volume, placement: Array, grid: Grid) -> Volume:
    """A file's volume, moved by a placement, on a grid: interpolated, or where the voxels are coarser, their means."""
    moved = Volume(volume.array, Grid(volume.grid.shape, placement @ volume.grid.affine), volume.quantity)
    coarser = bool(np.any(grid.spacing > 1.5 * moved.grid.spacing.max()))
    return resample(moved, grid, "mean" if coarser else "linear")
