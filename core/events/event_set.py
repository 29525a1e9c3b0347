"""Reading event sets: events as numpy arrays, by number or by what the index says."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from .. import hdf5
from ..arrays import Floats, Floats32
from ..errors import InputError
from ..files import AnyPath
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..physics.isotopes import isotope
from ..physics.noise import draw_counts
from ..runs.counting import live_shares_of, scaled
from ..runs.projecting import LINES
from ..runs.recipe import Recipe, recorded_recipe
from ..runs.run import ProjectionRun
from ..runs.run_recipe import recipe_model, with_phantom
from ..validation import freeze, positive
from ..volumes.images import Images
from ..volumes.volume import Volume
from .event_files import Place, read_array, read_truth
from .event_maker import radon_views
from .folders import SetFolder
from .index import column
from .planning import PlannedEvent, plan
from .recipe import EventRecipe

COUNTED = ("counts", "photons")
"""Units of images that have Poisson noise."""


def _numbers(name: str, text: str) -> Any:
    """A property of `Event`: an array of its file, with its docstring."""

    def read(event: Event) -> Floats:
        with event.opened() as file:
            return np.asarray(hdf5.read_numbers(event._dataset(file, name)), np.float64)

    return property(read, doc=text)


class Event:
    """One event of a set. Each access opens its file, reads what is asked for, and closes it."""

    def __init__(self, folder: SetFolder, number: int) -> None:
        self._folder, self.number = folder, number
        self._file: Any = None

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Its file, an ``h5py.File``, whose bytes are checked as they are read; `InputError` where it is damaged."""
        if self._file is not None:
            yield self._file
            return
        if not self.path.exists():
            vars(self._folder).pop("places", None)
        with hdf5.opened(self.path, self._place.offset) as file:
            if file.attrs["event"] != self.number or file.attrs["recipe_sha256"] != self.recipe.fingerprint:
                raise InputError("an event of another number or recipe")
            yield file

    @contextmanager
    def held(self) -> Iterator[Event]:
        """The same event with its file open, for several readings in one thread."""
        held = Event(self._folder, self.number)
        with self.opened() as held._file:
            yield held

    @property
    def _place(self) -> Place:
        return self._folder.places.get(self.number) or Place(str(self._folder.store.event_path(self.number)))

    @property
    def recipe(self) -> EventRecipe:
        """The recipe of its set."""
        return self._folder.recipe

    @property
    def path(self) -> Path:
        """Its file, or the shard that it is in."""
        return Path(self._place.path)

    @property
    def row(self) -> dict[str, Any]:
        """Its row of the index, by column."""
        return self._folder.index.values(self._folder.line(self.number))

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The attributes of its file."""
        with self.opened() as file:
            return hdf5.attributes(file)

    @property
    def name(self) -> str:
        """The phantom's name in the recipe."""
        return str(self.attributes["phantom"])

    @property
    def split(self) -> str | None:
        """Such as "train"; None where the recipe has no splits."""
        return self.attributes["split"] or None

    @property
    def settings(self) -> dict[str, Any]:
        """All settings of the phantom, or the names of its files."""
        return json.loads(self.attributes["settings"])

    @property
    def noise_seed(self) -> int:
        """The event's own seed of noise."""
        return int(self.attributes["noise_seed"])

    @property
    def planned(self) -> PlannedEvent:
        """How it was drawn, with its phantom."""
        return plan(self._folder.recipe, self.number)

    pose: Floats = _numbers("pose", "World-from-phantom pose (4, 4), mm: rotation and translation.")
    placement: Floats = _numbers("placement", "The pose with mirroring and the factor of size, (4, 4), mm.")
    position: Floats = _numbers("position", "Position of the phantom, (3,), mm.")
    euler_degrees: Floats = _numbers("euler_degrees", "phi, theta, psi of the phantom, (3,), degrees.")
    module_gain: Floats = _numbers("module_gain", "Factors (M,) of the modules' sensitivities in images of counts.")

    @property
    def truth(self) -> Volume:
        """The volume of which all images are."""
        return Volume(freeze(self.truth_part()), self.recipe.grid, self.recipe.quantity)

    def truth_part(self, part: tuple[slice, ...] = (), out: Floats32 | None = None) -> Floats32:
        """The numbers of the truth, or of a part of it, of which alone the bytes are read; into `out`, zeros, if given."""
        grid = self.recipe.grid
        with self.opened() as file:
            if "truth" in file:
                self._dataset(file, "truth", grid.shape)
            return read_truth(file, grid, part, out)

    @property
    def views(self) -> Views:
        """The views of its images."""
        return self._folder.maker.views

    @property
    def system(self) -> Scanner:
        """The scanner."""
        return self._folder.maker.system

    @property
    def models(self) -> list[str]:
        """The names of the models that it has images of."""
        with self.opened() as file:
            return list(file.get("images", ()))

    def unit(self, model: str) -> str:
        """The unit of a model's images, such as "counts"."""
        with self.opened() as file:
            return str(self._images(file, model).attrs["unit"])

    def images(
        self,
        model: str,
        noise_seed: int | None = None,
        level: float = 1.0,
        modules: Any = slice(None),
        out: Floats32 | None = None,
    ) -> Floats32:
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
        out
            Zeros, (M, n_v, n_u) float32, which the images of all modules are written to.

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
        with self.opened() as file:
            dataset = self._images(file, model)
            if (noise_seed is not None or level != 1.0) and dataset.attrs["unit"] not in COUNTED:
                unit = dataset.attrs["unit"]
                raise InputError(f"{model}: only counts and photons have noise and levels, its images are {unit}")
            one = isinstance(modules, slice) and modules.step in (None, 1)
            part = (modules, slice(None), slice(None)) if one and noise_seed is None else ()
            images = read_array(file, dataset.name, part, out)
        if level != 1.0:
            images *= np.float32(level)
        if noise_seed is not None:
            draw_counts(images, noise_seed, images)
        return images if part else images[modules]

    def radon(self, count: int) -> Floats32:
        """The parallel projections (count, n_v, n_u) at so many angles, value x mm."""
        with self.opened() as file:
            shape = None if self.recipe.radon is None else (count, *self.recipe.radon.shape)
            return Images.tag(read_array(file, self._dataset(file, f"radon/{count}", shape).name), self.recipe.quantity)

    def radon_views(self, count: int) -> Views:
        """The views of the parallel projections."""
        return radon_views(self._folder.recipe, count)

    def run(self, model: str, noise_seed: int | None = None, level: float = 1.0) -> ProjectionRun:
        """The images of a model as a projection run, with truth, scanner and recipe: to show, write or reconstruct.

        `level` is the share of the decays, and of the background, that are counted; the recipe's time is shortened to it.
        The recipe is left out where what attenuates is a phantom that no recipe of projections describes: with a factor of
        its activity, the mean of several gates, or a volume.
        """
        models = self._folder.recipe.models
        if model not in models:
            raise InputError(f"{model!r}: no such model; there are {', '.join(models) or 'none'}")
        settings: dict[str, Any] = {"model": model, "event": self.number, "volume": self.name}
        recipe = models[model] if level == 1.0 else _at_level(models[model], positive(level, "level"))
        record = self._record(recipe)
        if record is not None:
            settings["recipe"] = record.tables()
        made: Any = recipe_model(self._folder.recipe.placed(recipe), self.system)
        images = self.images(model, noise_seed, level)
        background = scaled(made.background, live_shares_of(recipe, images))
        return ProjectionRun(
            images, self.system, self.views, self.truth, unit=self.unit(model), settings=settings, seed=noise_seed,
            background=background, efficiency=made.efficiency,
        )  # fmt: skip

    def _record(self, model: Recipe) -> Recipe | None:
        """The recipe of a run of a model's images; None where none can say what attenuates."""
        planned, recipe = self.planned, self._folder.recipe
        files = {key: model[key] for key in ("system.file", "system.columns")}
        changes: dict[str, Any] = {key: str(recipe.input(name).path) for key, name in files.items() if name is not None}
        if (of_mu := model["attenuation.file"]) is not None:
            changes["attenuation.file"] = [str(recipe.input(name).path) for name in of_mu]
            if model["attenuation.energy"] != LINES:
                changes |= {"attenuation.energy": None}  # the set's copy holds mu
        record = recorded_recipe(recipe.placed(model.updated(changes)))
        if planned.phantom is not None and planned.entry["gates"] == 1 and planned.activity_factor == 1:
            own: dict[str, Any] = {"phantom.voxels": recipe.grid.shape, "phantom.spacing": recipe.grid.spacing.tolist()}
            if planned.file is not None:
                own["phantom.file"] = str(recipe.input(planned.file).path)
            return with_phantom(record.updated(own), planned.phantom, planned.placement)
        return None if model["attenuation.of_phantom"] else record

    def __repr__(self) -> str:
        return f"Event({self.number}, {self.path})"

    def _images(self, file: Any, model: str) -> Any:
        """The dataset of a model's images."""
        return self._dataset(file, f"images/{model}", (len(self.views), *self.views.shape))

    def _dataset(self, file: Any, name: str, shape: tuple[int, ...] | None = None) -> Any:
        """A dataset of the file, of the shape that the recipe says."""
        group, _, last = name.rpartition("/")
        there = file.get(group, {}) if group else file
        if last not in there:
            raise InputError(f"no {group or 'array'} of {last!r}; there are {', '.join(there) or 'none'}")
        if shape is not None and file[name].shape != shape:
            raise InputError(f"{name} of shape {file[name].shape}, the recipe says {shape}")
        return file[name]


def _at_level(recipe: Recipe, level: float) -> Recipe:
    """The recipe of a model whose images are a share of the counts of another's."""
    changes: dict[str, Any] = {key: level * recipe[key] for key in ("model.photons", "model.background") if recipe[key]}
    if recipe["model.kind"] == "emission":
        times, name = np.atleast_1d(recipe["model.time"]).tolist(), recipe["model.isotope"]
        known = None if name is None else isotope(name)
        changes["model.time"] = [known.duration(level, time) if known else level * time for time in times]
    return recipe.updated(changes)


class EventSet:
    """The events of one folder, or of several joined (``a + b``), in order of their numbers.

    It holds no open file and reads nothing before it is asked for: it can be pickled, and used in threads and in processes
    that fork or spawn.

    Parameters
    ----------
    folder
        The set's.

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

    def __init__(self, folder: AnyPath) -> None:
        found = SetFolder(folder)
        _ = found.recipe  # which every set has
        self._events = [Event(found, number) for number in found.places]

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
        """The numbers of the events, in order."""
        return [event.number for event in self._events]

    @property
    def index(self) -> list[dict[str, Any]]:
        """The rows of the index, one for each event."""
        return [event.row for event in self._events]

    @property
    def recipe(self) -> EventRecipe:
        """The recipe of the first event's set."""
        return self._first.recipe

    @property
    def system(self) -> Scanner:
        """The scanner of the first event's set."""
        return self._first.maker.system

    def where(self, holds: Callable[[Mapping[str, Any]], bool]) -> EventSet:
        """The events whose row of the index a function takes."""
        return self._of([event for event in self._events if holds(event.row)])

    def split(self, name: str) -> EventSet:
        """The events of a split, such as "train"; `InputError` where the recipe has no such split."""
        splits = [column(event._folder.line(event.number), 2) for event in self._events]
        known = set(splits) - {""} | (set(self.recipe.splits) if self._events else set())
        if name not in known:
            raise InputError(f"split {name!r}: there are {', '.join(sorted(known)) or 'none'}")
        return self._of([event for event, split in zip(self._events, splits, strict=True) if split == name])

    def __repr__(self) -> str:
        return f"EventSet({len(self)} events)"

    @property
    def _first(self) -> SetFolder:
        if not self._events:
            raise InputError("the event set holds no events")
        return self._events[0]._folder
