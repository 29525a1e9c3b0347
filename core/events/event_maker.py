"""Computation of one event's arrays: truth, images of every model, Radon images."""

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
from ..projector import Model, Projector
from ..rays.backends import choose
from ..recording import Remembered, recorded_warnings, remembered
from ..runs.projecting import Imaging, warn_of_energy
from ..runs.recipe import Recipe
from ..runs.run_recipe import read_attenuation, recipe_imaging, recipe_model, recipe_system, recipe_views, require_mu
from ..validation import freeze
from ..volumes.rearranging import centered
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from .planning import PlannedEvent, plan
from .recipe import EventRecipe

_CACHED_VOLUMES = 2
"""Volumes from files that are kept in memory, since events may share them."""
_WORKER_BYTES = 100 * 2**20
"""Memory of a worker's Python with its libraries, bytes."""


@dataclass(frozen=True, eq=False)
class EventArrays:
    """Computed arrays of an event with their units and warnings."""

    planned: PlannedEvent
    """Drawn parameters of the event."""
    truth: Volume
    """True volume, from which all images are simulated."""
    images: dict[str, Floats32]
    """Images (M, n_v, n_u) by model: expected means, background included."""
    units: dict[str, str]
    """Units of the images, by model."""
    radon: dict[int, Floats32]
    """Parallel projections (n, n_v, n_u) by number of angles n, value x mm."""
    gains: Floats
    """Factors (M,) of the modules' sensitivities in images of counts."""
    warnings: tuple[str, ...] = ()
    """Warnings that a projection run with the same settings would give."""


class EventMaker:
    """Maker of a recipe's events, which computes what they share (scanner, rays) once.

    `threads` is the number of threads of a projection, by default one per core; the images do not depend on it.
    """

    def __init__(self, recipe: EventRecipe, threads: int | None = None) -> None:
        self.recipe, self.threads = recipe, threads
        self._volumes: dict[str, Remembered[Volume]] = {}

    @cached_property
    def system(self) -> Scanner:
        """The scanner of all events."""
        return recipe_system(self.recipe.system, lambda name: self.recipe.input(name).path)

    @cached_property
    def views(self) -> Views:
        """The views of the images (M, n_v, n_u)."""
        return recipe_views(self.recipe.system, self.system)

    @property
    def raw_bytes(self) -> int:
        """The bytes of an event's arrays as float32, uncompressed."""
        recipe = self.recipe
        n_values = recipe.grid.n_voxels + len(recipe.models) * len(self.views) * math.prod(self.views.shape)
        if recipe.radon is not None:
            n_values += sum(recipe.radon.counts) * math.prod(recipe.radon.shape)
        return 4 * n_values

    def require_memory(self, workers: int = 1) -> None:
        """Raise `InputError` where `workers` events at once exceed the memory, or the scanner cannot be read."""
        purpose = f"an event of {readable_size(self.raw_bytes)}" if workers == 1 else f"{workers} workers"
        require(workers * (2.5 * self.raw_bytes + (workers > 1) * _WORKER_BYTES), purpose)

    def make(self, number: int, progress: Progress | None = None) -> EventArrays:
        """Compute event `number`; `progress` is called as ``progress(steps done, steps)`` and may raise `Cancelled`."""
        planned, recipe = plan(self.recipe, number), self.recipe
        self.require_memory()
        n_done, n_steps = 0, 1 + len(recipe.models) + (0 if recipe.radon is None else len(recipe.radon.counts))

        def step() -> None:
            """Report one further finished stage of the event."""
            nonlocal n_done
            n_done += 1
            tell(progress, n_done, n_steps)

        tell(progress, 0, n_steps)
        _ = self.system, choose("auto")  # their warnings come before the event, whose file must not hold them
        with naming(f"event {number}"), recorded_warnings() as warnings:
            truth = self.truth(planned)
            step()
            gains = planned.gains(len(self.system))
            images, units = {}, {}
            for name in recipe.models:
                with naming(name):
                    images[name], units[name] = self._model_images(name, planned, truth, gains)
                step()
            radon = {}
            for count, projector in self._radon_projectors.again().items():
                radon[count] = projector(truth)
                step()
        return EventArrays(planned, truth, images, units, radon, gains, tuple(dict.fromkeys(warnings)))

    def truth(self, planned: PlannedEvent) -> Volume:
        """Return the event's truth: the drawn phantom on the recipe's grid, times the factor of activity."""
        planned.made_phantom.again()
        volume = self._voxelize(planned, self.recipe.quantity)
        if planned.activity_factor == 1.0:
            return volume
        return Volume(freeze(volume.array * np.float32(planned.activity_factor)), volume.grid, volume.quantity)

    def _voxelize(self, planned: PlannedEvent, quantity: str) -> Volume:
        """Return the mean of the event's phantoms, or the volume of its file, on the grid of the truth."""
        grid, placement = self.recipe.grid, planned.placement
        if planned.entry.is_volume:
            file = planned.file if quantity == self.recipe.quantity else planned.mu_file
            assert file is not None  # the recipe refuses attenuation by a volume without a mu_file
            volume = self._read_volume(file)
            if planned.entry["center"] and planned.file is not None:  # the attenuation moves as far as the activity
                volume = centered(volume, volume.grid.center - self._read_volume(planned.file).grid.center)
            return _resample_placed(volume, placement, grid)
        volumes = [phantom.voxelize(grid, placement, quantity=quantity) for phantom in planned.phantoms]
        if len(volumes) == 1:
            return volumes[0]
        mean = sum(volume.array.astype(np.float64) for volume in volumes) / len(volumes)
        return Volume(freeze(np.asarray(mean, np.float32)), grid, quantity)

    def _read_volume(self, file: str) -> Volume:
        """Return the volume in a file that the recipe names, from memory where it is one of the last `_CACHED_VOLUMES`."""
        if file not in self._volumes:
            while len(self._volumes) >= _CACHED_VOLUMES:
                del self._volumes[next(iter(self._volumes))]
            self._volumes[file] = remembered(self.recipe.input(file).volume)
        return self._volumes[file].again()

    def _model_images(self, name: str, planned: PlannedEvent, truth: Volume, gains: Floats) -> tuple[Floats32, str]:
        """Return the expected images (M, n_v, n_u) of the truth by a model, and their unit."""
        recipe, imaging, mu = self.recipe.models[name], self._imagings[name].again(), None
        if recipe["attenuation.of_phantom"]:
            self._check_mu(planned, imaging.model)
            mu = self._voxelize(planned, "mu").array
        images = imaging.images(truth, mu, number=planned.number)
        if imaging.model.has_times and self.recipe["augmentation.module_gain"]:
            images *= gains.astype(np.float32)[:, None, None]
        return images, imaging.unit(truth)

    def _check_mu(self, planned: PlannedEvent, model: Model) -> None:
        """Raise `InputError` where the phantom has no attenuation; warn where mu is for another energy than the model's."""
        if planned.phantom is not None:
            require_mu(planned.phantom, model)
        elif planned.mu_file is not None:
            warn_of_energy(model, planned.entry["energy"], Path(planned.mu_file).name)

    @cached_property
    def _imagings(self) -> dict[str, Remembered[Imaging]]:
        """The simulators of each model's images, by model, with the warnings that their construction gave."""
        imagings = {}
        for name, recipe in self.recipe.models.items():
            with naming(f"models.{name}"):
                imagings[name] = remembered(partial(self._make_imaging, recipe))
        return imagings

    def _make_imaging(self, recipe: Recipe) -> Imaging:
        """Return the image simulator of a model's recipe on the grid of the truth."""
        grid, placed = self.recipe.grid, self.recipe.placed(recipe)
        mu = read_attenuation(recipe, recipe_model(placed, self.system), lambda file: self.recipe.input(file).volume())
        if recipe["attenuation.of_phantom"]:  # a placeholder for the grid: each event has its own mu
            mu = Volume(freeze(np.zeros(grid.shape, np.float32)), grid, "mu")
        return recipe_imaging(placed, self.system, self.views, grid, mu, threads=self.threads)

    @cached_property
    def _radon_projectors(self) -> Remembered[dict[int, Projector]]:
        """The projectors of the Radon images by number of angles, with the warnings that their construction gave."""
        recipe, counts = self.recipe, () if self.recipe.radon is None else self.recipe.radon.counts
        projector = partial(Projector, recipe.grid, threads=self.threads)
        return remembered(lambda: {n: projector(radon_views(recipe, n)) for n in counts})


def radon_views(recipe: EventRecipe, count: int) -> Views:
    """Return the parallel views of a recipe's Radon images at `count` angles; `InputError` where it has none."""
    if recipe.radon is None or count not in recipe.radon.counts:
        counts = () if recipe.radon is None else recipe.radon.counts
        raise InputError(f"radon: expected a number of angles of {', '.join(map(str, counts)) or 'none'}, got {count}")
    angles = math.radians(recipe.radon.degrees) / count * np.arange(count)
    return parallel_views(angles, recipe.radon.shape, recipe.radon.pitch, center=recipe.grid.center)


def _resample_placed(volume: Volume, placement: Array, grid: Grid) -> Volume:
    """Resample a volume, moved by a placement (4, 4), onto a grid: by interpolation, or by means onto coarser voxels."""
    moved = Volume(volume.array, Grid(volume.grid.shape, placement @ volume.grid.affine), volume.quantity)
    coarser = bool(np.any(grid.spacing > 1.5 * moved.grid.spacing.max()))
    return resample(moved, grid, "mean" if coarser else "linear")
