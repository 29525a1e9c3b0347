"""Reading event sets: events as numpy arrays, by number or by what the index says."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..physics.noise import sample_counts
from ..runs.recipe import Recipe, recorded_recipe
from ..runs.run import ProjectionRun
from ..runs.run_recipe import recipe_model, with_phantom
from ..validation import freeze, positive
from ..volumes.images import Images
from ..volumes.volume import Volume
from .event_files import header, names_of, read_array, read_truth
from .folders import SetFolder
from .making import EventMaker, radon_views
from .planning import PlannedEvent, plan
from .recipe import EventRecipe

Floats = NDArray[np.float64]

COUNTED = ("counts", "photons")
"""Units of images that have Poisson noise."""


class _Source:
    """What the events of one folder share."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = SetFolder(folder)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Source, (self.folder.path,)

    @property
    def recipe(self) -> EventRecipe:
        return self.folder.recipe

    @cached_property
    def maker(self) -> EventMaker:
        """It has scanner and views."""
        return EventMaker(self.recipe)

    @cached_property
    def rows(self) -> dict[int, dict[str, Any]]:
        """The index by event."""
        return {row["event"]: row for row in self.folder.rows()}


def _numbers(name: str, text: str) -> Any:
    """A property of `Event`: an array of its file, with its docstring."""

    def read(event: Event) -> Floats:
        with event._open() as file:
            return np.asarray(file[name][()], np.float64)

    return property(read, doc=text)


class Event:
    """One event of a set. Each access opens its file, reads what is asked for, and closes it."""

    def __init__(self, source: _Source, number: int) -> None:
        self._source, self.number = source, number

    @property
    def recipe(self) -> EventRecipe:
        """Of its set."""
        return self._source.recipe

    @property
    def path(self) -> Path:
        """Its file."""
        return self._source.folder.event_path(self.number)

    @property
    def row(self) -> dict[str, Any]:
        """Its row of the index, by column."""
        row = self._source.rows.get(self.number)
        return plan(self._source.recipe, self.number).row() if row is None else row

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """Of its file."""
        with self._open() as file:
            items = file.attrs.items()
            return {name: value.item() if isinstance(value, np.generic) else value for name, value in items}

    @property
    def name(self) -> str:
        """Of the phantom in the recipe."""
        return str(self.attributes["phantom"])

    @property
    def split(self) -> str | None:
        """Such as "train"; None where the recipe has no splits."""
        return self.attributes["split"] or None

    @property
    def settings(self) -> dict[str, Any]:
        """All settings of the phantom, or the names of its files."""
        settings: dict[str, Any] = json.loads(self.attributes["settings"])
        return settings

    @property
    def noise_seed(self) -> int:
        """The event's own seed of noise."""
        return int(self.attributes["noise_seed"])

    @property
    def planned(self) -> PlannedEvent:
        """How it was drawn, with its phantom."""
        return plan(self._source.recipe, self.number)

    pose: Floats = _numbers("pose", "World-from-phantom pose (4, 4), mm: rotation and translation.")
    placement: Floats = _numbers("placement", "The pose with mirroring and the factor of size, (4, 4), mm.")
    position: Floats = _numbers("position", "Of the phantom, (3,), mm.")
    euler_degrees: Floats = _numbers("euler_degrees", "phi, theta, psi of the phantom, (3,), degrees.")
    module_gain: Floats = _numbers(
        "module_gain", "Factors (M,) of the modules' sensitivities, in the images of counts."
    )

    @property
    def truth(self) -> Volume:
        """The volume of which all images are."""
        grid, quantity = self._source.recipe.grid, self._source.recipe.quantity
        with self._open() as file:
            return Volume(freeze(read_truth(file, grid)), Grid(grid.shape, file["truth_affine"][()]), quantity)

    @property
    def views(self) -> Views:
        """Of the images."""
        return self._source.maker.views

    @property
    def system(self) -> PinholeSystem:
        """The scanner."""
        return self._source.maker.system

    @property
    def models(self) -> list[str]:
        """The names of the models that it has images of."""
        with self._open() as file:
            return list(names_of(file, "images"))

    def unit(self, model: str) -> str:
        """Of a model's images, such as "counts"."""
        with self._open() as file:
            return str(self._dataset(file, "images", model).attrs["unit"])

    def images(
        self, model: str, noise_seed: int | None = None, level: float = 1.0, modules: Any = slice(None)
    ) -> NDArray[np.float32]:
        """A model's images.

        Parameters
        ----------
        model
            Its name in the recipe.
        noise_seed
            Draws Poisson counts (`sample_counts`), the same each time; `noise_seed` of the event is its own. None: the
            expected means.
        level
            Share of the acquisition time; only of counts and photons.
        modules
            Which of them: an index, a slice or a list of indices. Their noise does not depend on the others.

        Returns
        -------
        array (M, n_v, n_u), float32
            In the unit of `unit`; column index along +u, row index along +v. Of one index, (n_v, n_u).

        Raises
        ------
        InputError
            No such model, or noise or a level of images that are no counts.
        """
        level = positive(level, "level")
        with self._open() as file:
            dataset = self._dataset(file, "images", model)
            if (noise_seed is not None or level != 1.0) and dataset.attrs["unit"] not in COUNTED:
                unit = dataset.attrs["unit"]
                raise InputError(f"{model}: only counts and photons have noise and levels, its images are {unit}")
            images = read_array(file, f"images/{model}", () if noise_seed is not None else modules)
        if level != 1.0:
            images *= np.float32(level)
        if noise_seed is None:
            return images
        return sample_counts(images, noise_seed)[modules].astype(np.float32)

    def radon(self, count: int) -> NDArray[np.float32]:
        """The parallel projections (count, n_v, n_u) at so many angles, value x mm."""
        with self._open() as file:
            self._dataset(file, "radon", str(count))
            return Images.of(read_array(file, f"radon/{count}"), self._source.recipe.quantity)

    def radon_views(self, count: int) -> Views:
        """Of the parallel projections."""
        return radon_views(self._source.recipe, count)

    def run(self, model: str, noise_seed: int | None = None) -> ProjectionRun:
        """The images of a model as a projection run, with truth, scanner and recipe: to show, write or reconstruct.

        The recipe is left out where what attenuates is a phantom that no recipe of projections describes: with a factor of
        its activity, the mean of several gates, or a volume.
        """
        models = self._source.recipe.models
        if model not in models:
            raise InputError(f"{model!r}: no such model; there are {', '.join(models) or 'none'}")
        settings: dict[str, Any] = {"model": model, "event": self.number, "volume": self.name}
        record = self._record(models[model])
        if record is not None:
            settings["recipe"] = record.tables()
        background, unit = recipe_model(models[model], self.system).background, self.unit(model)
        return ProjectionRun(
            self.images(model, noise_seed), self.system, self.views, self.truth, unit=unit, settings=settings,
            seed=noise_seed, background=background,
        )  # fmt: skip

    def _record(self, model: Recipe) -> Recipe | None:
        """The recipe of a run of a model's images; None where none can say what attenuates."""
        planned, recipe = self.planned, self._source.recipe
        files = {key: model[key] for key in ("system.file", "system.columns", "attenuation.file")}
        changes: dict[str, Any] = {key: str(recipe.input(name).path) for key, name in files.items() if name is not None}
        if "attenuation.file" in changes:
            changes |= {"attenuation.energy": None}  # the set's copy holds mu
        record = recorded_recipe(model.updated(changes))
        if planned.phantom is not None and planned.entry.gates == 1 and planned.activity_factor == 1:
            own: dict[str, Any] = {"phantom.voxels": recipe.grid.shape, "phantom.spacing": recipe.grid.spacing.tolist()}
            if planned.file is not None:
                own["phantom.file"] = str(recipe.input(planned.file).path)
            return with_phantom(record.updated(own), planned.phantom, planned.placement)
        return None if model["attenuation.of_phantom"] else record

    def __repr__(self) -> str:
        return f"Event({self.number}, {self.path})"

    def _open(self) -> Any:
        import h5py

        try:
            return h5py.File(self.path, "r")
        except OSError:
            header(self.path)  # says what is wrong, where it knows
            raise InputError(f"{self.path}: cannot be read as HDF5; mphdrr events check says more") from None

    def _dataset(self, file: Any, group: str, name: str) -> Any:
        if name not in names_of(file, group):
            known = ", ".join(names_of(file, group)) or "none"
            raise InputError(f"{self.path}: no {group} of {name!r}; there are {known}")
        return file[group][name]


class EventSet:
    """The events of one folder, or of several joined (``a + b``), in order of their numbers.

    It holds no open file and reads nothing before it is asked for: it can be pickled, and used in threads and in processes
    that fork or spawn.

    Parameters
    ----------
    folder
        Of the set.

    Raises
    ------
    InputError
        The folder is no event set.

    Examples
    --------
    >>> events = mph.events.EventSet("set")
    >>> train = events.split("train")
    >>> hot = events.where(lambda row: row["phantom.activity"] > 50)
    >>> train[0].truth.array.shape
    (256, 256, 256)
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        source = _Source(folder)
        _ = source.recipe  # which every set has
        self._events = [Event(source, number) for number in source.folder.numbers()]

    @classmethod
    def _of(cls, events: list[Event]) -> EventSet:
        made = cls.__new__(cls)
        made._events = events
        return made

    def __len__(self) -> int:
        return len(self._events)

    if TYPE_CHECKING:  # typing keeps overloads for ever, and with them all that can be reached from here, such as bpy

        @overload
        def __getitem__(self, index: int) -> Event: ...
        @overload
        def __getitem__(self, index: slice) -> EventSet: ...
        def __getitem__(self, index: Any) -> Any: ...

    else:

        def __getitem__(self, index: Any) -> Any:
            found = self._events[index]
            return self._of(found) if isinstance(index, slice) else found

    def __iter__(self) -> Iterator[Event]:
        return iter(self._events)

    def __add__(self, other: EventSet) -> EventSet:
        return self._of([*self._events, *other._events])

    @property
    def numbers(self) -> list[int]:
        """Of the events, in order."""
        return [event.number for event in self._events]

    @property
    def index(self) -> list[dict[str, Any]]:
        """The rows of the index, one for each event."""
        return [event.row for event in self._events]

    @property
    def recipe(self) -> EventRecipe:
        """Of the first event's set."""
        return self._first.recipe

    @property
    def system(self) -> PinholeSystem:
        """The scanner of the first event's set."""
        return self._first.maker.system

    def where(self, holds: Callable[[Mapping[str, Any]], bool]) -> EventSet:
        """The events whose row of the index a function takes."""
        return self._of([event for event in self._events if holds(event.row)])

    def split(self, name: str) -> EventSet:
        """The events of a split, such as "train"; `InputError` where the recipe has no such split."""
        found = self.where(lambda row: row["split"] == name)
        known = {row["split"] for row in self.index if row["split"]}
        if not found and name not in known | set(self.recipe.splits):
            raise InputError(f"split {name!r}: there are {', '.join(sorted(known)) or 'none'}")
        return found

    def __repr__(self) -> str:
        return f"EventSet({len(self)} events)"

    @property
    def _first(self) -> _Source:
        if not self._events:
            raise InputError("the event set holds no events")
        return self._events[0]._source
